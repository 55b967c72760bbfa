"""The settings of mapping: measurements, association, estimation, live sessions and outputs."""

from typing import Annotated, Literal

from pydantic import Field

from objslam.config.section import Count, Device, Finite, Names, NotNegative, Positive, Section, Share

Loss = Literal["l1", "huber", "cauchy", "gnc"]


class Poses(Section):
    """Configure which poses of a log are used."""

    use: Literal["auto", "odometry", "localization"] = "auto"
    """Poses to use if a log has both odometry and a localisation. auto uses the localisation, and in joint mode also the
    odometry between localised poses. If the localisation covers too few boxes, auto uses the odometry alone, unless the mode
    is fixed. If the localisation was lost for a while, auto does so only if the mode is auto."""
    max_gap: Positive = 1.1
    """Longest gap in s between two consecutive poses across which poses are interpolated. A frame in a longer gap is dropped
    and counted. In joint mode, the odometry bridges longer gaps of the localisation."""
    jumps: Literal["correct", "keep"] = "correct"
    """How jumps of the localisation by at most 1 m are treated. correct: the path before and after each jump is joined, and
    the map says that nobody knows which side of the jump was right. If the boxes agree better with the jumps, the poses stay
    as they are. keep: the poses stay as they are. With checks.use=false, the poses always stay as they are."""


class RayNoise(Section):
    """Configure how boxes become rays."""

    pixel_sigma: Positive = 3.0
    """Standard deviation of a box centre per axis in px."""
    box_sigma: NotNegative = 0.05
    """Standard deviation of a box centre as a share of the box size, added in quadrature to pixel_sigma. The box size is the
    geometric mean of width and height."""
    unknown_size: NotNegative = 0.2
    """Assumed width and height in m of an object whose boxes do not show its size. Such boxes come, for example, from a
    sensor that measures only bearings. The noise box_sigma is a share of this size. With 0, such an object is a point."""
    min_score: NotNegative = 0.0
    """Lowest score of a box that is used. A box with a lower score is dropped and counted."""
    ignore_labels: Names = ()
    """Labels whose boxes are not used, for example [person, dog]. Such boxes are dropped and counted. A label is written as
    in the log. In a comparison or a merge of maps, this run says nothing about objects with such a label."""
    border: Finite = 1.0
    """Distance in px from the image edge within which a box counts as cut off. The centre of such a box is not the centre of
    its object. So the box gives no ray, and is counted. Its edges are used only for the body of the object. With a negative
    value, such boxes give rays."""
    border_share: NotNegative = 0.07
    """Distance from the image edge within which a box also counts as cut off, as a share of the box width or height. It is
    needed because the boxes of detectors often end before the edge that cuts off the object."""
    robot_parts: bool = True
    """Drop boxes that stay at one place of the image while the camera turns. Such boxes usually show a part of the robot."""
    second_labels: bool = True
    """Drop a box that is nearly equal to a box of another label with a higher score in the same frame. This is done for two
    labels if most of their overlapping boxes are nearly equal. A detector that suppresses boxes for each label separately
    may give one thing two such boxes."""


class Depth(Section):
    """Configure the depth at a box. The depth is optional and is used as a range along the ray of the box."""

    use: bool = True
    sigma: Positive = 0.03
    """Constant part of the standard deviation of a range in m."""
    sigma_per_m: NotNegative = 0.02
    """Part of the standard deviation of a range that grows with the distance, in m per m."""
    bias: NotNegative = 0.05
    """Standard deviation in m of the error that all ranges of one object share, because of its shape or a calibration error.
    Averaging does not reduce this error."""
    centre: NotNegative = 0.5
    """Distance in depth from the visible surface of a thing to its centre, as a share of half the width of the thing. It is
    0 for a sign and 1 for a ball. It is needed because a measured depth ends on the surface. Use 0 if the depths of a log
    are depths of centres."""
    centre_sigma: NotNegative = 0.3
    """Standard deviation of the true share `centre` over the things of a log."""


class Odometry(Section):
    """Configure the drift of odometry. The drift is a random walk, so its standard deviations grow with the square root of
    the motion. If the path is not planar, all three axes have the noise of x, and all three rotations have the noise of the
    heading."""

    x_per_m: NotNegative = 0.02
    """Standard deviation along the driving direction in m after 1 m of driving."""
    y_per_m: NotNegative = 0.005
    """Standard deviation across the driving direction in m after 1 m of driving. The default is small because wheels hardly
    move sideways. An omnidirectional base may need the value of x_per_m."""
    xy_per_rad: NotNegative = 0.005
    """Standard deviation of the position in m after 1 rad of turning in place."""
    yaw_per_m: NotNegative = 0.02
    """Standard deviation of the heading in rad after 1 m of driving."""
    yaw_per_rad: NotNegative = 0.05
    """Standard deviation of the heading in rad after 1 rad of turning."""
    floor_xy: Positive = 1e-3
    """Standard deviation of the position in m that each keyframe step has even if the robot stands still."""
    floor_yaw: Positive = 1e-3
    """Standard deviation of the heading in rad that each keyframe step has even if the robot stands still."""


class Planar(Section):
    """Configure how far the robot deviates from a planar path. A real floor is not perfectly flat. The defaults suit a floor
    in a house. Grass, tracks and slopes deviate far more. A run estimates how far (noise.ground)."""

    z: Positive = 1e-3
    """Standard deviation of the height in m."""
    tilt: Positive = 1e-3
    """Standard deviation of roll and of pitch in rad."""
    seconds: NotNegative = 0.0
    """Time in s after which the correlation of tilt, and of height, has fallen to 1/e. This time is used only in joint mode
    with a localisation. With 0, tilt and height are independent in each pose. Fixed mode estimates the time instead."""


class Localization(Section):
    """Configure the accuracy of the poses of a localisation."""

    xy: Positive = 0.02
    """Standard deviation of x and of y in m."""
    yaw: Positive = 0.005
    """Standard deviation of the heading in rad."""


class AssociationSettings(Section):
    """Configure how rays are associated with objects."""

    method: Literal["auto", "global", "by_label"] = "auto"
    """Association method. by_label: each label is one object. global: several objects may share a label. auto uses by_label
    if hardly any frame has two boxes of one label, and few rays miss the only object of their label. Otherwise auto uses
    global. In joint mode, if many rays miss, auto estimates the noise from the log and decides once more."""
    hypotheses: Annotated[int, Field(ge=16)] = 1024
    """Maximum number of ray pairs that the search tests for each label in one pass. Each pair gives a candidate point of an
    object. With a larger value, the search is slower and finds rarer objects."""
    gate: Annotated[float, Field(gt=0, lt=1)] = 0.999
    """Share of an object's own boxes that pass the gate on the ray residual. With a larger value, the gate accepts more
    wrong boxes."""
    min_existence: Share = 0.5
    """Existence probability below which an object is dropped. The probability is computed from detections and missed
    detections."""
    min_rays: Annotated[int, Field(ge=2)] = 3
    """Minimum number of rays of an object. Two rays of different things often intersect, so two rays are not enough. One or
    two more rays are needed while the poses have not converged. A larger value finds fewer and more certain objects."""
    few_rays: bool = True
    """Search for objects with fewer rays than min_rays, in fixed mode with a localisation. Two rays, or one ray with a
    depth, are enough if such rays hardly meet by chance. The probability of such an object still has to reach
    min_existence."""
    duplicate_distance: Positive = 1.0
    """Distance in m above which two objects of one label are never merged. With a larger value, more duplicates are merged
    on a path that has drifted."""
    loop_evidence: Positive = 7.0
    """Minimum log odds that the current landmarks are the landmarks of a place visited earlier. With smaller log odds, the
    loop is not closed. A larger value closes fewer loops."""
    loop_lead: NotNegative = 3.0
    """Minimum difference in log odds between the best place and the second-best place. With a smaller difference, the loop
    is not closed. A larger value confuses fewer similar places."""
    fuse_labels: bool = True
    """Merge objects of different labels into one object with several labels if they are the same thing."""


class Triangulation(Section):
    """Configure the triangulation of objects from rays with known poses."""

    device: Device = "auto"
    consensus: bool = True
    """Use only the rays of an object that agree on one point, so that outliers do not shift the object."""
    hypotheses: Count = 256
    """Maximum number of ray pairs that are tested for each object. Each pair gives a candidate point. A larger value
    tolerates more outliers and is slower."""
    min_parallax_deg: NotNegative = 3.0
    """Minimum parallax in degrees between the rays of an object. An object with less parallax is unresolved."""
    max_rel_sigma: Positive = 0.5
    """Maximum standard deviation of a position as a share of its distance from the cameras. An object with a larger share is
    unresolved. At 0.5, two standard deviations reach the camera, so the covariance does not describe the error."""
    sure_sigma: Positive = 0.5
    """Standard deviation in m above which `explain` and the verdict name an object as unsure. The status of such an object
    stays ok. By default, `objslam eval` counts an object as missed if its position errs by more than 0.5 m. A larger value
    names fewer objects."""


class Bodies(Section):
    """Configure the bodies of objects. A body is an upright ellipsoid, cuboid or cylinder that fits the edges of the boxes
    of its object."""

    use: bool = True
    """Give each object a body if its boxes show its shape. The position of an object with a body is the centre of the body.
    The position of any other object is the point at which the rays through the box centres meet."""
    sizes: dict[str, tuple[Positive, Positive, Positive]] = Field(default_factory=dict)
    """Known length, width and height in m by label. The sizes of other labels are learnt from the log."""


class Fixed(Section):
    """Configure the estimation of objects when the robot's poses are given and not estimated."""

    loss: Loss = "l1"
    """Robust loss of a ray. l1 is Eq. 1, the sum of the distances between an object and its rays. If an object was seen from
    few sides, l1 draws it towards the robot. The other losses depend on the angle between the ray and the object, in units
    of the noise of the ray. For drives with such objects, the other losses were better than l1 in simulation, but not in
    recordings."""


class Joint(Section):
    """Configure the joint estimation of the robot's poses and the objects."""

    loss: Loss = "huber"
    factor: Literal["bearing", "point_to_line"] = "bearing"
    """Factor that links a ray to its object in the graph. bearing measures the angle between the ray and the object.
    point_to_line measures the distance of the object from the ray, as Eq. 1 does. With free poses, point_to_line shrinks the
    map, because a smaller map has smaller distances."""
    min_parallax_deg: NotNegative = 8.0
    """Minimum parallax in degrees that the rays of a landmark must have before the landmark enters the growing graph."""
    prior_sigma: Positive = 20.0
    """Standard deviation in m of a weak prior on each landmark. The prior keeps the graph determined."""
    grow_step: Annotated[int, Field(ge=2)] = 60
    """Number of keyframes added per step if the log has odometry only."""
    explore_step: Count = 10
    """Number of keyframes added per step while the association is unknown. Places are recognised from predicted poses, and
    predictions are accurate over short distances only."""
    max_rounds: Count = 6
    """Maximum number of rounds of association and solving. The rounds stop early if no ray changes its object."""
    max_solves: Count = 150
    """Maximum number of solves in the search for the map of a log without names. After this number, the search tries no
    other start, path or loop, and tests no further object for being false. Searches that ended with right maps took up to
    121 solves. With a smaller number, the search ends sooner."""
    max_iterations: Count = 100


class Live(Section):
    """Configure the mapping while the robot drives."""

    keyframe_distance: NotNegative = 0.01
    """Distance in m that the camera must move from the last keyframe to a new keyframe. While the camera stands still, its
    first ten frames are keyframes too."""
    keyframe_angle_deg: NotNegative = 0.5
    """Angle in degrees by which the camera must turn from the last keyframe to a new keyframe. A frame also becomes a
    keyframe if it shows a label that no keyframe at the current place shows."""
    max_keyframes: Annotated[int, Field(ge=50)] = 1500
    """Maximum number of keyframes. It bounds memory and time. If a session has more keyframes, it removes a quarter of this
    number of older keyframes with their boxes. It joins the odometry before and after each removed keyframe."""
    max_lag: Positive = 0.35
    """Maximum waiting time of a frame in s. A frame that waits longer is dropped and counted."""
    max_late: Positive = 2.0
    """Maximum time in s by which a frame may be older than the newest pose. An older frame is refused and counted."""
    max_frames_waiting: Count = 64
    """Maximum number of frames that wait for their poses. If more frames wait, the oldest of them is dropped and counted."""
    max_speed: Positive = 5.0
    """Speed in m/s above which a step of the odometry counts as a jump. A step also counts as a jump if its turn rate in
    rad/s exceeds four times this number. After a jump, the path continues from the pose before it."""
    min_rays: Annotated[int, Field(ge=3)] = 5
    """Minimum number of boxes that agree on an object before the object enters the graph. The default exceeds
    association.min_rays, because a live session knows only the poses up to now."""
    ghost_share: Share = 0.1
    """Minimum share of detections: the number of frames in which an object was detected, divided by the number of frames
    that should show the object. An object with a smaller share is dropped. A larger value also drops true objects."""
    ghost_frames: Count = 40
    """Minimum number of frames that should have shown an object before it can be dropped. With a larger value, false objects
    stay longer."""
    journal_segment_mb: Annotated[float, Field(ge=0.001)] = 64.0
    """Size in MB at which a segment of the journal is closed and compressed, and the next one begins."""
    journal_free_mb: NotNegative = 200.0
    """Free space in MB at which the journal stops, so that the robot's disk does not fill up. The mapping goes on. On a disk
    of less than 50 times this size, the limit is 2 % of the disk."""
    reassociate: Annotated[int, Field(ge=0)] = 6000
    """Maximum number of boxes up to which a session repeats the offline association at its end. The repetition takes a few
    seconds. If the map of the session is unclear, it takes as long as an offline run."""
    calibrate_from: Annotated[int, Field(ge=0)] = 60
    """Number of keyframes at which the session first estimates the shared errors and the noise of the localisation. The
    session repeats the estimate whenever the number of keyframes has grown by half. With 0, the session estimates them only
    at its end."""
    search_from: Annotated[int, Field(ge=0)] = 75
    """Number of keyframes at which the session first repeats the association of its whole drive. It does so only if a label
    may have several objects. The offline association runs in a separate process. It runs again whenever the number of
    keyframes has grown by 30 %, up to `reassociate` boxes. With 0, it runs only at the end of the session."""
    forget: Positive = 5.0
    """Time in s without a new box after which a track with fewer than min_rays boxes is dropped. A track is a group of boxes
    that may become an object. The boxes of a dropped track belong to no object."""


class Reconstruction(Section):
    """Configure the surface of the room, which is fused from depth images at the estimated poses."""

    use: bool = True
    """Reconstruct the surface if the log has depth images."""
    before: bool = False
    """Also reconstruct the surface at the poses of the log, to compare it with the surface at the estimated poses."""
    cloud: bool = False
    """Also write the points of the surface with normals to a separate file."""
    device: Device = "auto"
    voxel: Positive = 0.02
    """Edge length of a voxel in m."""
    truncation: Positive = 0.06
    """Distance in m from a surface within which the depths of several images are averaged. It should exceed the depth error
    and 2 voxels. It should be smaller than the thickness of things."""
    max_depth: Positive = 4.0
    """Maximum depth in m. Larger depths are ignored."""
    min_views: Count = 3
    """Minimum number of depth images that must show a part of the surface. Any other part is left out."""
    stride: Count = 1
    """Step between the depth images that are used, as a number of images. With 1, every depth image is used."""
    max_frames: Annotated[int, Field(ge=1, le=65535)] = 1000
    """Maximum number of depth images that are used. If there are more, images at even intervals are used."""
    max_blocks: Annotated[int, Field(ge=2048)] = 80_000
    """Maximum number of blocks of 6^3 voxels in the grid. A block takes 4.3 kB."""


class Output(Section):
    """Configure the files that a run writes."""

    recording: bool = True
    images: Annotated[int, Field(ge=0)] = 1000
    """Maximum number of images of each camera in the recording. These images are spread evenly over the drive. With 0, the
    recording has no images."""
    image_width: Annotated[int, Field(ge=16)] = 480
    """Maximum width in px of an image in the recording. A wider image is reduced by an integer factor."""
    picture: bool = True
