"""What people look at: pure functions of a `consat.results.result.Result`. Nothing here loads matplotlib before a figure is asked for."""
