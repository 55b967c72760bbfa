"""The settings of mapping: measurements, association, estimation, live sessions and outputs."""

from typing import Annotated, Literal

from pydantic import Field

from objslam.config.section import Count, Device, Finite, NotNegative, Positive, Section, Share

Loss = Literal["l1", "huber", "cauchy", "gnc"]


class Poses(Section):
    """Configure which poses of a log are used."""

    use: Literal["auto", "odometry", "localization"] = "auto"
    """Poses to use if a log has odometry and localisation. auto uses the localisation. In joint mode, auto also uses the
    odometry between localised poses. It uses the odometry alone if the localisation covers too few boxes, or was lost."""
    max_gap: Positive = 1.1
    """Maximum time in s between two consecutive poses of the path. A frame in a longer gap is dropped and counted. In joint
    mode, the odometry bridges longer gaps of the localisation."""
    jumps: Literal["correct", "keep"] = "correct"
    """What happens to jumps of the localisation that are shorter than 1 m. correct: the path is joined at each jump, unless
    the boxes refute it. The map then says that nobody knows which side was right. keep: the poses stay as they are. With
    checks.use=false, they always stay."""


class RayNoise(Section):
    """Configure how boxes become rays."""

    pixel_sigma: Positive = 3.0
    """Standard deviation of a box centre per axis in px."""
    box_sigma: NotNegative = 0.05
    """Box centre noise as a share of the box size (geometric mean of width and height), added in quadrature to
    pixel_sigma."""
    unknown_size: NotNegative = 0.2
    """Assumed width and height in m of an object whose boxes do not show its size, such as the boxes of a sensor that
    measures only bearings. box_sigma is a share of it. 0: such an object is a point."""
    min_score: NotNegative = 0.0
    """Lowest score of a box that is used. A box with a lower score is dropped and counted."""
    border: Finite = 1.0
    """Distance in px from the image edge within which a box counts as cut off. The centre of such a box is not the centre of
    its object, so the box gives no ray, and is counted. Only bodies use its edges. A negative value keeps such boxes."""
    border_share: NotNegative = 0.07
    """Distance from the image edge within which a box also counts as cut off, as a share of the box width or height.
    Detectors often end a cut box short of the edge."""
    robot_parts: bool = True
    """Drop boxes that stay at one place of the image while the camera turns, such as those of a part of the robot."""
    second_labels: bool = True
    """Drop a box that is nearly equal to a surer box of another label in its frame, if most boxes of the two labels that lie
    on each other are nearly equal. A detector whose suppression works label by label may give a thing two such boxes."""


class Depth(Section):
    """Configure the depth at a box. The depth is optional and is used as a range along the ray of the box."""

    use: bool = True
    sigma: Positive = 0.03
    """Constant part of the range noise in m."""
    sigma_per_m: NotNegative = 0.02
    """Part of the range noise that grows with the distance, in m per m."""
    bias: NotNegative = 0.05
    """Standard deviation in m of the error that all ranges of one object share, because of its shape or a calibration error.
    Averaging does not reduce this error."""
    centre: NotNegative = 0.5
    """How far the centre of a thing is behind its visible surface, as a share of half its width: 0 for a sign, 1 for a ball.
    A depth ends on the surface. 0 is for depths of centres."""
    centre_sigma: NotNegative = 0.3
    """Standard deviation by which the share `centre` differs between the things of a log."""


class Odometry(Section):
    """Configure odometry drift, a random walk whose standard deviations grow with the square root of the motion. On a path
    that is not planar, all three axes have the noise of x, and all three rotations have the noise of the heading."""

    x_per_m: NotNegative = 0.02
    """Standard deviation along the driving direction in m after 1 m of driving."""
    y_per_m: NotNegative = 0.005
    """Standard deviation across the driving direction in m after 1 m of driving. It is small for wheels. An omnidirectional
    base may need the value of x_per_m."""
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
    in a house. Grass, tracks and slopes deviate by far more, and a run estimates by how much (noise.ground)."""

    z: Positive = 1e-3
    """Standard deviation of the height in m."""
    tilt: Positive = 1e-3
    """Standard deviation of roll and of pitch in rad."""
    seconds: NotNegative = 0.0
    """Time in s after which the correlation of tilt, and of height, is 1/e. It counts in joint mode with a localisation. 0:
    both are new in each pose. In fixed mode, it is estimated."""


class Localization(Section):
    """Configure the accuracy of absolute poses."""

    xy: Positive = 0.02
    """Standard deviation of x and of y in m."""
    yaw: Positive = 0.005
    """Standard deviation of the heading in rad."""


class AssociationSettings(Section):
    """Configure how rays are associated with objects."""

    method: Literal["auto", "global", "by_label"] = "auto"
    """Association method. by_label: each label is one object. global: several objects may share a label. auto uses by_label
    if hardly any frame has two boxes of one label, and few rays miss the single object of their label. Otherwise auto uses
    global. In joint mode, if many rays miss, auto decides again with the noise estimated from the log."""
    hypotheses: Annotated[int, Field(ge=16)] = 1024
    """Number of ray pairs whose points are tested per label in one pass. A larger value is slower and finds rarer
    objects."""
    gate: Annotated[float, Field(gt=0, lt=1)] = 0.999
    """Share of an object's own boxes that pass the gate on the ray residual. A larger value accepts more wrong boxes."""
    min_existence: Share = 0.5
    """Existence probability below which an object is dropped. It is computed from detections and missed detections."""
    min_rays: Annotated[int, Field(ge=2)] = 3
    """Minimum number of rays of an object, because two rays of different things often intersect. One or two more rays are
    needed while the poses have not converged. A larger value finds fewer and more certain objects."""
    few_rays: bool = True
    """Search for objects with fewer rays than min_rays, in fixed mode with a localisation. Two rays, or one ray with a
    depth, are enough if such rays hardly meet by chance. The probability of such an object still has to reach
    min_existence."""
    duplicate_distance: Positive = 1.0
    """Distance in m above which two objects of one label are never merged. A larger value merges more on a drifted path."""
    loop_evidence: Positive = 7.0
    """Minimum log odds that the current landmarks are landmarks of an earlier place. A larger value closes fewer loops."""
    loop_lead: NotNegative = 3.0
    """Minimum lead in log odds of the best place over the second-best place. With a smaller lead, a loop is not closed. A
    larger value confuses fewer similar places."""
    fuse_labels: bool = True
    """Merge objects of different labels that are the same thing into one object with several labels."""


class Triangulation(Section):
    """Configure the triangulation of objects from rays with known poses."""

    device: Device = "auto"
    consensus: bool = True
    """Use only the rays of an object that agree on one point, so that outliers do not shift the object."""
    hypotheses: Count = 256
    """Number of ray pairs whose points are tested per object. A larger value tolerates more outliers and is slower."""
    min_parallax_deg: NotNegative = 3.0
    """Minimum parallax in degrees between the rays of an object. An object with less parallax is unresolved."""
    max_rel_sigma: Positive = 0.5
    """Maximum standard deviation of a position as a share of its distance from the cameras. A less certain
    object is unresolved: twice this deviation then reaches the camera, and the covariance does not describe it."""
    sure_sigma: Positive = 0.5
    """Standard deviation in m above which `explain` and the verdict name an object as unsure. Its status stays ok. Beyond
    0.5 m, `objslam eval` by default counts an object as missed. A larger value names fewer objects."""


class Bodies(Section):
    """Configure the bodies of objects: upright ellipsoids, cuboids and cylinders that fit the edges of their boxes."""

    use: bool = True
    """Give each object a body if its boxes show one. Its position is then the centre of the body. Otherwise, the position
    is the point at which the rays through the box centres meet."""
    sizes: dict[str, tuple[Positive, Positive, Positive]] = Field(default_factory=dict)
    """Known length, width and height in m by label. The sizes of other labels are learnt from the log."""


class Fixed(Section):
    """Configure the estimation of objects when the robot's poses are given and not estimated."""

    loss: Loss = "l1"
    """Robust loss of a ray. l1 is Eq. 1, the sum of the distances between an object and its rays. It draws an object seen
    from few sides towards the robot. The other losses are on the angle of a ray in units of its noise. In such drives they
    are better than l1. In recorded drives they are not."""


class Joint(Section):
    """Configure the joint estimation of the robot's poses and the objects."""

    loss: Loss = "huber"
    factor: Literal["bearing", "point_to_line"] = "bearing"
    """Factor of a ray. bearing measures the angle between the ray and its object. point_to_line measures the distance, as
    Eq. 1 does. With free poses it shrinks the map, because a smaller map has smaller distances."""
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
    """Maximum number of solves in the search for the map of a log without names. After it, no other start, path or loop is
    tried, and no other object as a false one. Searches that ended with right maps took up to 121 solves. A smaller number
    ends sooner."""
    max_iterations: Count = 100


class Live(Section):
    """Configure the mapping while the robot drives."""

    keyframe_distance: NotNegative = 0.01
    """Camera motion in m from the last keyframe to a new keyframe. While the camera stands, the first ten frames are
    keyframes too."""
    keyframe_angle_deg: NotNegative = 0.5
    """Camera rotation in degrees from the last keyframe to a new keyframe. A frame also becomes a keyframe if it shows a
    label that no keyframe at the current place shows."""
    max_keyframes: Annotated[int, Field(ge=50)] = 1500
    """Maximum number of keyframes, to bound memory and time. Above it, older keyframes are removed with their boxes, a
    quarter of this number at a time. The odometry before and after each removed keyframe is joined."""
    max_lag: Positive = 0.35
    """Maximum waiting time of a frame in s. A frame that waits longer is dropped and counted."""
    max_late: Positive = 2.0
    """Maximum time in s by which the timestamp of a frame may be older than the newest pose."""
    max_frames_waiting: Count = 64
    """Maximum number of waiting frames. Above it, the oldest frame is dropped and counted."""
    max_speed: Positive = 5.0
    """Speed in m/s above which odometry counts as a jump. A turn rate in rad/s above four times this number is also a
    jump. After a jump, odometry continues from the last pose."""
    min_rays: Annotated[int, Field(ge=3)] = 5
    """Minimum number of consistent boxes before an object enters the graph. It exceeds association.min_rays, because a live
    session knows only the current poses."""
    ghost_share: Share = 0.1
    """Minimum share of detections among the frames that should show an object. An object with a smaller share is dropped. A
    larger value drops true objects too."""
    ghost_frames: Count = 40
    """Number of frames that should show an object before it can be dropped. A larger value keeps false objects longer."""
    journal_segment_mb: Annotated[float, Field(ge=0.001)] = 64.0
    """Size in MB at which a segment of the journal is closed and compressed, and the next one begins."""
    journal_free_mb: NotNegative = 200.0
    """Free space in MB at which the journal stops, so that the robot's disk does not fill up. The mapping goes on. On a disk
    of less than 50 times this size, the limit is 2 % of the disk."""
    reassociate: Annotated[int, Field(ge=0)] = 6000
    """Maximum number of boxes with which a session repeats the offline association at its end. This takes a few seconds, and
    as long as an offline run if the map of the session is unclear."""
    calibrate_from: Annotated[int, Field(ge=0)] = 60
    """Number of keyframes at which the session first estimates the shared errors and the noise of the localisation. It
    estimates them again whenever the number of keyframes has grown by half. 0 estimates them only at the end of the
    session."""
    search_from: Annotated[int, Field(ge=0)] = 75
    """Number of keyframes at which the session first associates its whole drive again, if a label may have several objects.
    The offline association runs in a process beside the session. It runs again whenever the number of keyframes has grown
    by 30 %, up to `reassociate` boxes. 0 does so only at the end of the session."""
    forget: Positive = 5.0
    """Time in s without observation after which a track with fewer than min_rays boxes is dropped. Its boxes stay
    unexplained."""


class Reconstruction(Section):
    """Configure the surface of the room, which is fused from depth images at the estimated poses."""

    use: bool = True
    """Reconstruct the surface if the log has depth images."""
    before: bool = False
    """Also reconstruct the surface at the poses of the log, for comparison."""
    cloud: bool = False
    """Also write the points of the surface with normals to a separate file."""
    device: Device = "auto"
    voxel: Positive = 0.02
    """Edge length of a voxel in m."""
    truncation: Positive = 0.06
    """Distance in m from a surface within which depths are averaged. It should exceed the depth error and 2 voxels,
    but not the thickness of things."""
    max_depth: Positive = 4.0
    """Maximum depth in m. Larger depths are ignored."""
    min_views: Count = 3
    """Minimum number of depth images that show a surface before the surface is kept."""
    stride: Count = 1
    """Step between the depth images that are used. 1 uses every depth image."""
    max_frames: Annotated[int, Field(ge=1, le=65535)] = 1000
    """Maximum number of depth images. If there are more, images at even intervals are used."""
    max_blocks: Annotated[int, Field(ge=2048)] = 80_000
    """Maximum number of blocks of 6^3 voxels in the grid. A block takes 4.3 kB."""


class Output(Section):
    """Configure the files that a run writes."""

    recording: bool = True
    images: Annotated[int, Field(ge=0)] = 1000
    """Maximum number of images of each camera in the recording. They are spread evenly. 0 records no images."""
    image_width: Annotated[int, Field(ge=16)] = 480
    """Maximum width in px of an image in the recording. A wider image is reduced by an integer factor."""
    picture: bool = True
