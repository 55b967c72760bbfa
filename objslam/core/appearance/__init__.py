"""What boxes look like: appearance vectors. They are compared by their cosine.

Everything that stores, compares or learns from vectors goes through this folder.
"""
