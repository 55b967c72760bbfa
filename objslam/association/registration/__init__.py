"""Registers two maps whose frames are unknown to each other.

Proposals come from pairs of objects. Fits make them precise, and the number of false alarms judges them.
"""
