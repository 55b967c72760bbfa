"""Read and write files, with one module per format. Folders are defined in `sources`, `results` and `output`."""
