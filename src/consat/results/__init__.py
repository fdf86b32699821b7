"""Results of runs: `Trace` (plain arrays), `Result` (the public object) and the NetCDF file.

Input: a trace and its summary. Output: labelled arrays and files. This package must not import the packages that compute: engine, network,
runs.
"""
