"""Decide which ray belongs to which object, offline and live, by gates, assignment, existence and place recognition.

A thing is a physical object. A landmark is the estimate of a thing, and becomes an object of the map. A phantom is a
landmark where no thing is. A stray box or ray belongs to no landmark (clutter). A stretch is a connected part of the drive.

Poses and factors are in `graph`. The state of a live map is in `live.mapper`.
"""
