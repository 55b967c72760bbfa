"""The file names of a result folder and the readers of its files. The folder `output` writes these files."""
