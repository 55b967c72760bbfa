"""Name the files of a result folder and read them. The folder `output` writes them."""
