"""How likely two boxes show one object, from what they look like: a likelihood ratio of cosines, learnt from the log itself.

Without appearance vectors, nothing in this folder changes anything.
"""
