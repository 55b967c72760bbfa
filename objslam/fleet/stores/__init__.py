"""The stores of a fleet: folders of this machine, and object stores through fsspec.

Logs are read from sources, and results are kept in stores.
"""
