"""The stores of a fleet: folders of this machine, and object stores through fsspec.

Logs are read from sources, results are kept in stores, and both say what is wrong in one line.
"""
