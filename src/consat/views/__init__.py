"""Figures, films, pages and texts from a `consat.results.result.Result`. matplotlib is imported only when a figure is drawn."""
