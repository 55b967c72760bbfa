"""Landmarks where the rays of two things cross. A bundle is the rays from one stretch of the path.

one_or_two compares one thing and two as explanations of the rays of a landmark. bundles divides the rays. positions fits
points to bundles. usual_views holds what is usual in a class.
"""
