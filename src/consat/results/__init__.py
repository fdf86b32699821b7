"""What a run leaves behind: `Trace`, plain arrays; `Result`, which users get; and the NetCDF file.

In: a trace and its summary. Out: labelled arrays, files. May not import what computes: engine, network, runs.
"""
