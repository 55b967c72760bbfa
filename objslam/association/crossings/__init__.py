"""Repair landmarks where the rays of two things cross, and landmarks that exchanged rays. A bundle is a group of rays from
one stretch of the path.

ghost_pairs replaces two landmarks at crossings by two things. one_or_two compares one thing and two as explanations of the
rays of a landmark. exchanged_rays lets the appearance of boxes decide. bundles divides the rays. positions fits points to
bundles. usual_views holds what is usual in a class.
"""
