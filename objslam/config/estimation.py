"""The settings of association, triangulation and the factor graph."""

from typing import Annotated, Literal

from pydantic import Field

from objslam.config.section import Count, Device, NotNegative, Positive, Section, Share

Loss = Literal["l1", "huber", "cauchy", "gnc"]


class AssociationSettings(Section):
    """Configure how rays are associated with objects."""

    method: Literal["auto", "global", "by_label"] = "auto"
    """Association method. by_label: each label is one object. global: several objects may share a label. auto uses by_label
    if no frame has two boxes of one label and few rays miss the single object of their label. Otherwise auto uses global."""
    hypotheses: Annotated[int, Field(ge=16)] = 1024
    """Number of points from ray pairs tested per label in one pass. A larger value finds rarer objects and takes longer."""
    gate: Annotated[float, Field(gt=0, lt=1)] = 0.999
    """Share of an object's own boxes that pass the gate on the residual of a ray. A larger value accepts more wrong
    boxes."""
    min_existence: Share = 0.5
    """Existence probability below which an object is dropped. It is computed from detections and missed detections."""
    min_rays: Annotated[int, Field(ge=2)] = 3
    """Minimum number of rays of an object, because two rays of different things often intersect. One or two more rays are
    needed while the poses have not converged. A larger value finds fewer and more certain objects."""
    duplicate_distance: Positive = 1.0
    """Distance in m above which two objects of one label are never merged. A larger value merges more on a drifted path."""
    loop_evidence: Positive = 7.0
    """Minimum log odds that current landmarks match those of an earlier place. A larger value closes fewer loops."""
    loop_lead: NotNegative = 3.0
    """Minimum lead in log odds of the best place over the second best to close a loop. A larger value separates similar
    places."""
    fuse_labels: bool = True
    """Merge objects of different labels that are the same thing into one object with several labels."""


class Triangulation(Section):
    """Configure the triangulation of objects from rays with known poses."""

    device: Device = "auto"
    consensus: bool = True
    """Start from the point with the largest consensus of ray pairs, so that outliers do not shift an object."""
    hypotheses: Count = 256
    """Number of ray pairs tested per object."""
    min_parallax_deg: NotNegative = 3.0
    """Minimum parallax in degrees between the rays of an object. An object with less parallax is unresolved."""
    max_rel_sigma: Positive = 0.5
    """Maximum standard deviation of a position as a share of the distance. A less certain object is unresolved."""


class Fixed(Section):
    """Configure the estimation of objects with fixed poses."""

    loss: Loss = "l1"


class Joint(Section):
    """Configure the joint estimation of poses and objects."""

    loss: Loss = "huber"
    factor: Literal["bearing", "point_to_line"] = "bearing"
    """Factor of a ray. point_to_line is Eq. 1. With free poses it shrinks the map, because distances shrink with the
    scale."""
    min_parallax_deg: NotNegative = 8.0
    """Minimum parallax in degrees between its rays before a landmark enters the growing graph."""
    prior_sigma: Positive = 20.0
    """Standard deviation in m of a weak prior on each landmark. The prior keeps the graph determined."""
    grow_step: Annotated[int, Field(ge=2)] = 60
    """Number of keyframes added per step if the log has odometry only."""
    explore_step: Count = 10
    """Number of keyframes added per step while the association is unknown. Places are recognised from predicted poses, and
    predictions are accurate over short distances only."""
    max_rounds: Count = 6
    """Maximum number of rounds of association and solving. The rounds stop early if no ray changes its object."""
    max_iterations: Count = 100
