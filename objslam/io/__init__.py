"""Read and write files with one module per format, and report errors with file and line.

The meaning of a folder of files is defined in other rooms: logs in `sources`, results in `results` and `output`.
"""
