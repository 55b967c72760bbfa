"""Find the topics of each camera, its calibration and its pose on the robot."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.errors import LogError
from objslam.io.camera_yaml import Calibration, Mount
from objslam.ros.messages.camera_info import camera_names, camera_of
from objslam.ros.messages.topic_types import COMPRESSED
from objslam.ros.tf.tree import TfTree
from objslam.ros.topics import closeness, is_named, is_rectified, mount_of
from objslam.sources.ros_bag.survey import Topic
from objslam.sources.ros_bag.topic_roles import TopicPool
from objslam.sources.ros_bag.trajectories import tf_path


@dataclass(frozen=True)
class CameraTopics:
    """The topics of one camera. A topic is None if the camera does not have it.

    frame: the name of the optical frame of the camera. info: the topic of its CameraInfo. calibration: the calibration from
    a file, None without a file. rectified: whether boxes and images are rectified.
    """

    name: str
    frame: str
    detections: Topic | None
    image: Topic | None
    depth: Topic | None
    info: Topic | None
    calibration: Calibration | None
    rectified: bool


def find_cameras(
    pool: TopicPool, tree: TfTree, calibrations: Sequence[Calibration], rectified: bool | None
) -> tuple[CameraTopics, ...]:
    """Return the cameras of a recording with their topics.

    The calibrations and the topics determine the cameras:

    - With calibrations from a file, each calibration is a camera. The topics of this camera have its name as a part of their
      name or frame_id. If there is a single calibration and no such topic, the camera gets all topics. If there are several
      calibrations, one without such topics is left out with a warning.
    - Otherwise, each frame_id of detections is a camera.
    - Without detections, each frame_id that colour images share with a CameraInfo is a camera. A single topic of colour
      images is always a camera.
    - Without detections and images, each frame_id of a CameraInfo is a camera, and each calibration is one.

    The other topics of a camera have its frame_id. If several topics fit a role, the topic with the most similar name is
    taken with a warning. rectified: whether boxes and images are rectified. With None, the topic names determine this.
    """
    detections, images = pool.fitting("detections"), pool.fitting("image")
    seeds = detections or images or pool.fitting("camera_info")
    if calibrations:
        alone = len(calibrations) == 1
        named = {c.camera.name: [t for t in seeds if is_named(c.camera.name, t.frame, t.name)] for c in calibrations}
        if alone and not any(named.values()):
            named = {name: list(seeds) for name in named}
        for name in (name for name, topics in named.items() if not topics and (detections or images)):
            pool.ledger.warn(f"camera {name!r}: no topics, left out (--topic {name}.detections=/name or {name}.image=/name)")
        taken = {topic.name for topics in named.values() for topic in topics}
        for topic in (topic for topic in detections if topic.name not in taken):
            pool.ledger.warn(f"{topic.name}: left out, because no calibration has a fitting name ({', '.join(named)})")
        cameras = []
        for calibration in calibrations:
            name = calibration.camera.name
            chosen = any((name, role) in pool.choices.names for role in ("detections", "image"))
            if named[name] or chosen or not (detections or images):
                frame = named[name][0].frame if named[name] else name
                cameras.append(_gather(pool, tree, name, frame, named[name], calibration, rectified, alone))
        return tuple(cameras)
    if images and not detections:
        infos = pool.fitting("camera_info")
        seeds = [topic for topic in images if len(images) == 1 or any(info.frame == topic.frame for info in infos)]
    frames = list(dict.fromkeys(topic.frame for topic in seeds))
    return tuple(
        _gather(pool, tree, name, frame, [t for t in seeds if t.frame == frame], None, rectified, len(frames) == 1)
        for name, frame in zip(camera_names(frames), frames, strict=True)
    )


def build_camera(
    topics: CameraTopics, tree: TfTree, base: str, ledger: Ledger, mounts: Sequence[Mount] = ()
) -> tuple[Camera, Trajectory | None]:
    """Return the camera of `topics`, and base_T_camera over time, which is None if base_T_camera never changes.

    base: the name of the base frame. mounts: base_T_camera of cameras with a CameraInfo, from a file. These poses replace
    the poses from tf.
    Raises LogError if the calibration is missing or tf does not connect base with the camera.
    """
    given = topics.calibration
    if given is not None and given.placed:
        return replace(given.camera, name=topics.name), None
    if given is not None:
        camera, correction = replace(given.camera, name=topics.name), given.camera.base_T_camera
    elif topics.info is not None:
        if len(topics.info.infos) > 1:
            ledger.warn(f"{topics.info.name}: the calibration changes during the recording, the first one is used")
        info = next(iter(topics.info.infos.values()))
        camera, correction = camera_of(info, topics.name, topics.info.name, topics.rectified)
        mount = mount_of(mounts, topics.frame, (topics.detections or topics.image or topics.info).name)
        if mount is not None:
            return replace(camera, base_T_camera=mount.base_T_camera), None
    else:
        hint = f"give --topic {topics.name}.camera_info=/name, or --camera-info FILE"
        what = f"no CameraInfo belongs to this camera (frame {topics.frame!r})"
        raise LogError(what, where=f"camera {topics.name}", hint=hint)
    if not topics.frame:
        what = "its messages have no frame_id, so tf cannot place it on the robot"
        hint = "set it to the optical frame of the camera, or give --camera-info FILE: base_T_camera with translation and "
        raise LogError(what, where=f"camera {topics.name}", hint=hint + "rotation_xyzw")
    base_T_frame = tree.still(base, topics.frame)
    if base_T_frame is not None:
        return replace(camera, base_T_camera=base_T_frame @ correction), None
    stamps, poses = tf_path(tree, base, topics.frame)
    if not len(stamps):
        raise LogError(f"tf {base} -> {topics.frame} is incomplete at all stamps", where=f"camera {topics.name}")
    return camera, Trajectory(stamps, poses @ correction)


def _gather(
    pool: TopicPool,
    tree: TfTree,
    name: str,
    frame: str,
    seeds: Sequence[Topic],
    calibration: Calibration | None,
    rectified: bool | None,
    alone: bool,
) -> CameraTopics:
    """Return a camera with all its topics. seeds: the topics of detections, images or CameraInfo that define the camera.

    The other images of the camera have the frame_id `frame`. alone: whether this is the only camera. The only camera also
    gets images with another frame_id, if the user chose these images or if the camera has no frame_id. The CameraInfo has
    the frame_id `frame`. Without such a CameraInfo, one with a similar name is taken, or any one if no name is similar.
    """

    def mine(role: str) -> list[Topic]:
        rest = alone and (not frame or bool(pool.choices.of(role)))
        return [topic for topic in pool.fitting(role) if topic in seeds or rest or (frame and topic.frame == frame)]

    detections = pool.choose("detections", [topic for topic in pool.fitting("detections") if topic in seeds], name)
    near = detections.name if detections else seeds[0].name if seeds else ""
    info = None
    if calibration is None:
        infos = pool.fitting("camera_info")
        infos = [t for t in infos if t.frame == frame] or [t for t in infos if closeness(t.name, near)] or infos
        infos = sorted(infos, key=lambda topic: (-closeness(topic.name, near), "depth" in topic.name.lower()))
        same = len({key for topic in infos for key in topic.infos}) == 1
        info = pool.choose("camera_info", infos[:1] if same else infos, name)
        if info is not None and info.frame in tree.frames and frame not in tree.frames:
            frame = info.frame
    near = info.name if info else near
    images = sorted(mine("image"), key=lambda topic: (-closeness(topic.name, near), topic.type == COMPRESSED))
    images.sort(key=lambda topic: is_rectified(topic.name) != bool(rectified))
    image = pool.choose("image", images, name)
    depths = sorted(mine("depth"), key=lambda topic: (topic.type == COMPRESSED, -closeness(topic.name, near)))
    depth = pool.choose("depth", depths, name)
    if rectified is None:
        rectified = is_rectified((image or detections or depth or seeds[0]).name) if image or detections or seeds else False
    return CameraTopics(name, frame, detections, image, depth, info, calibration, rectified)
