"""The settings of association, triangulation and the factor graph."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from objslam.config.section import Device, NotNegative, Positive, Section

Loss = Literal["l1", "huber", "cauchy", "gnc"]


class AssociationSettings(Section):
    """Which ray belongs to which object."""

    method: Literal["auto", "global", "by_label"] = "auto"
    """by_label: every label is one object. global: several objects may share a label. auto: by_label where no frame has two
    boxes of one label and hardly a ray disagrees with the one object, else global."""
    hypotheses: Annotated[int, Field(ge=16)] = 1024
    """points from pairs of rays that are tried at a time for each label; more finds rare objects and takes longer."""
    gate: Annotated[float, Field(gt=0, lt=1)] = 0.999
    """share of an object's own boxes that pass the gate on how far a ray misses it; larger lets in more wrong boxes."""
    min_existence: Annotated[float, Field(ge=0, le=1)] = 0.5
    """probability of existence, from where an object was detected and where not, below which it is dropped."""
    min_rays: Annotated[int, Field(ge=2)] = 3
    """rays that an object has at the least; two rays of different things often meet. While poses are not settled yet, one or
    two more are asked for. Larger finds fewer and surer objects."""
    duplicate_distance: Positive = 1.0
    """m; two objects of a label that are further apart are never one. Larger lets a drifted path merge more."""
    loop_evidence: Positive = 7.0
    """log odds that landmarks here are those of a place seen before, below which no loop is closed. Larger closes fewer."""
    loop_lead: NotNegative = 3.0
    """log odds of that place over the best other one, below which no loop is closed. Larger tells lookalikes apart."""
    fuse_labels: bool = True
    """objects of different labels that are one thing become one object with several labels."""


class Triangulation(Section):
    """Objects from rays with known poses."""

    device: Device = "auto"
    consensus: bool = True
    """start from the best agreement of ray pairs, so that outliers do not move an object."""
    hypotheses: Annotated[int, Field(ge=1)] = 256
    """ray pairs tried for each object."""
    min_parallax_deg: NotNegative = 3.0
    """an object whose rays span less is unresolved."""
    max_rel_sigma: Positive = 0.5
    """an object whose position is less certain than this share of its distance is unresolved."""


class Fixed(Section):
    """Objects with the poses as they are."""

    loss: Loss = "l1"


class Joint(Section):
    """Poses and objects together."""

    loss: Loss = "huber"
    factor: Literal["bearing", "point_to_line"] = "bearing"
    """point_to_line is Eq. 1; with free poses it shrinks the map, since a smaller world has smaller distances."""
    min_parallax_deg: NotNegative = 8.0
    """a landmark enters the growing graph once its rays span this much."""
    prior_sigma: Positive = 20.0
    """m; a weak prior on each landmark that keeps the graph determined."""
    grow_step: Annotated[int, Field(ge=2)] = 60
    """keyframes added at a time when there is odometry alone."""
    explore_step: Annotated[int, Field(ge=1)] = 10
    """keyframes added at a time while it is not known which ray belongs to which object; places are recognised from
    predictions, which are good over a short way only."""
    max_rounds: Annotated[int, Field(ge=1)] = 6
    """rounds of association and solve at the most; they end earlier when no ray changes its object."""
    max_iterations: Annotated[int, Field(ge=1)] = 100
