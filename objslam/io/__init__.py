"""Read and write files, with one module per format.

`results` reads result folders back. Folders of logs are in `sources`, and `output` writes results.
"""
