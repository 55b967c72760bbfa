"""Register two maps if the transform between their frames is unknown.

Pairs of objects propose transforms. Fits make the transforms precise, and the number of false alarms judges them.
"""
