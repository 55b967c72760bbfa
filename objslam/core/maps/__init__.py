"""What is true of a map as a whole, not of one of its objects.

All objects of a map share an error. Its covariance is part of the covariance of each object. An index of all positions
answers spatial queries.
"""
