"""Read and write files, with one module per format.

`results` reads result folders. The package `sources` reads the folders of logs, and the package `output` writes results.
"""
