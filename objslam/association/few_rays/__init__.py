"""Find objects from few rays, after the global association at localised poses.

Two rays, or one ray with a range, can show an object if they hardly meet by chance.
"""
