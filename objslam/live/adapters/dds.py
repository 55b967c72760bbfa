"""Receives the messages of a ROS 2 robot over DDS, without an installed ROS."""

import math
import threading
import time
from dataclasses import dataclass, field
from typing import Any

from objslam.live.dds.network import AUTO, LOOPBACK, Network, receive_buffer
from objslam.live.dds.publications import MOST, Kind, Publication, Publications
from objslam.live.dds.types import dds_topic, layouts_of, ros_topic, ros_type
from objslam.live.ros.message_handler import RosMessages
from objslam.live.ros.topic_discovery import HEAD_START, LONELY, LOOK_EVERY, QUEUE, STOP_WAIT, TopicChoice
from objslam.ros.bag.records import Connection, plain
from objslam.ros.message_limits import check_size
from objslam.ros.messages.decode import DecodeError, make_decoder
from objslam.ros.messages.topic_types import IMAGES, LATCHED, is_read

_TAKE = 50
"""The most messages that are taken from one reader before the next reader's turn. With a larger number, a flood of one topic
delays the other topics more, but each message takes a little less time."""
_MAX_READERS = 256  # The most open readers. A larger number costs memory.
_MIN_BUFFER = 2 << 20  # The socket buffer, bytes, below which raw images cause a warning. A larger value warns more often.


@dataclass
class _Reader:
    """A DDS reader for all publishers of one topic with one QoS kind. of: the publication of one such publisher.

    since: when the reader was made, s, by `time.monotonic`. lost: the number of lost messages that are already counted.
    """

    of: Publication
    entity: Any
    decode: Any
    since: float
    lost: int = 0
    warned: bool = False


@dataclass
class _Heard:
    """What two readers received of one publisher.

    own: the stamp, ns, of the first message that the reader of the publisher's kind received. It is infinite before this
    message. others: the stamps, ns, of the last QUEUE messages that the other reader pushed before this message.
    """

    own: float = math.inf
    others: dict[int, None] = field(default_factory=dict)


@dataclass
class DdsAdapter:
    """Reads the topics of the wanted types, while their publishers come and go.

    A topic has one reader per kind of publisher: best-effort or reliable, volatile or transient-local. A reader with a
    stricter QoS than its publisher receives nothing, and a reader with a weaker QoS may lose messages.
    """

    network: Network
    messages: RosMessages
    choice: TopicChoice
    _publications: Publications = field(init=False)
    _readers: dict[tuple[str, Kind], _Reader] = field(default_factory=dict)
    _topics: dict[str, Any] = field(default_factory=dict)
    _unread: dict[str, int] = field(default_factory=dict)
    _heard: dict[int, _Heard] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.ledger = self.messages.ledger
        self._publications = Publications(self._kept)

    def run(self, stop: threading.Event) -> None:
        """Push messages until `stop` is set."""
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
        from cyclonedds.util import duration

        new = ViewState.Any | SampleState.NotRead | InstanceState.Any
        found = BuiltinDataReader(self.network.participant, BuiltinTopicDcpsPublication)
        waitset = WaitSet(self.network.participant)
        waitset.attach(ReadCondition(found, new))
        begin, looked = time.monotonic(), 0.0
        while not stop.is_set():
            waitset.wait(duration(seconds=STOP_WAIT))
            self._look_around(found)
            for reader in self._readers.values():
                self._take(reader, found)
            now = time.monotonic()
            if now - looked >= LOOK_EVERY:
                looked = now
                for reader in self._open(now - begin):
                    waitset.attach(ReadCondition(reader.entity, new))
                self.messages.tick()
                self._count_losses()
                self._say_what_is_missing(now - begin)

    def _look_around(self, found: Any) -> None:
        from cyclonedds.core import InstanceState

        for _ in range(QUEUE // _TAKE):  # The readers get their turn even if publishers come without end.
            samples = found.take(_TAKE)
            for sample in samples:
                handle = sample.sample_info.instance_handle
                if sample.sample_info.instance_state != InstanceState.Alive or not sample.sample_info.valid_data:
                    self._publications.remove(handle)
                    continue
                topic, type_ = ros_topic(sample.topic_name), ros_type(sample.type_name)
                if topic is None or type_ is None or not is_read(type_):
                    continue
                own = sample.participant_key == self.network.participant.guid
                kind = _kind(sample.qos, type_)
                out = self._publications.add(handle, Publication(plain(topic), type_, kind, sample.type_id, own))
                if out is not None:
                    self.messages.refuse(f"publisher beyond the {MOST} that are kept", out.topic)
            if len(samples) < _TAKE:
                return

    def _kept(self) -> set[str]:
        """Return the topics that are read, and the topics that the user chose."""
        return {topic for topic, _ in self._readers}.union(*self.choice.chosen.names.values())

    def _open(self, age: float) -> list[_Reader]:
        """Open readers for the wanted topics without a reader, and return the new readers. age: the time since the start,
        s."""
        offered = {publication.topic: publication.type for publication in self._publications}
        wanted = self.choice.wanted(offered, self.messages, settled=age >= HEAD_START)
        opened = []
        for publication in self._publications:
            key = publication.topic, publication.kind
            fits = publication.topic in wanted and publication.type == offered[publication.topic]
            if fits and key not in self._readers and len(self._readers) < _MAX_READERS:
                reader = self._make_reader(publication)
                if reader is not None:
                    self._readers[key] = reader
                    opened.append(reader)
        order = {type_: rank for rank, type_ in enumerate(LATCHED)}  # Boxes need earlier transforms and calibrations.
        self._readers = dict(sorted(self._readers.items(), key=lambda item: order.get(item[1].of.type, len(order))))
        return opened

    def _make_reader(self, publication: Publication) -> _Reader | None:
        from cyclonedds.core import DDSException, Policy, Qos
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        topic, type_, (reliable, latched) = publication.topic, publication.type, publication.kind
        layouts: tuple[Any, ...] = layouts_of(type_)
        if not layouts:
            self.ledger.warn(f"{topic}: left out, because its type {type_} is unknown and DDS sends no definitions")
            return None
        declared = publication.type_id  # None for older publishers, which declare no type id.
        fitting = (layout for layout in layouts if declared is not None and layout.__idl__.get_type_id() == declared)
        layout = next(fitting, layouts[0])
        images = type_ in IMAGES
        qos = Qos(
            Policy.Reliability.Reliable(0) if reliable else Policy.Reliability.BestEffort,
            Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
            Policy.History.KeepLast(1 if images else QUEUE),
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.IgnoreLocal.Participant,  # This session's own tf map -> odom must not come back as a localisation.
        )
        if images and (receive_buffer() or _MIN_BUFFER) < _MIN_BUFFER:
            self.ledger.warn("the system's socket buffers are too small for images: run sysctl -w net.core.rmem_max=4194304")
        try:
            if topic not in self._topics:
                self._topics[topic] = Topic(self.network.participant, dds_topic(topic), layout)
            entity: Any = DataReader(self.network.participant, self._topics[topic], qos=qos)
        except DDSException as error:
            self.ledger.warn(f"{topic}: cannot be subscribed to ({error.msg})")
            return None
        return _Reader(publication, entity, make_decoder(Connection(topic, type_, "cdr")), time.monotonic())

    def _take(self, reader: _Reader, found: Any) -> None:
        """Push messages that wait in a reader, at most _TAKE, so that other readers and a stop do not wait long."""
        for sample in reader.entity.take(_TAKE):
            info = sample.sample_info
            if not info.valid_data or not self._is_mine(reader, info.publication_handle, info.source_timestamp, found):
                continue
            try:
                check_size(reader.of.type, sample.data, "cdr")
                message = reader.decode(sample.data)
            except DecodeError as error:
                self.messages.refuse("message that cannot be decoded", f"{reader.of.topic}: {error}")
                continue
            self.messages.receive(reader.of.type, reader.of.topic, message, info.source_timestamp / 1e9)

    def _is_mine(self, reader: _Reader, handle: int, stamp: int, found: Any) -> bool:
        """Return whether this reader pushes a message of the publisher with this handle. stamp: the time of sending, ns.

        Two readers may receive one message, because a best-effort reader receives from reliable publishers too. The reader
        of the publisher's own kind pushes it. Until the reader of the own kind receives the publisher, the other reader
        pushes the publisher's messages, because a robot may send as soon as anybody listens. If the publisher is unknown,
        the reader with the strictest QoS pushes.
        """
        if self._publications.kind(handle) is None:
            self._look_around(found)
        kind = self._publications.kind(handle)
        if kind is None:
            kinds = [kind for topic, kind in self._readers if topic == reader.of.topic]
            return reader.of.kind == max(kinds)
        _, latched = kind
        if latched:
            return kind == reader.of.kind  # This reader receives old messages too, so no other has to push them.
        heard = self._heard.setdefault(handle, _Heard())
        if len(self._heard) > MOST:
            del self._heard[next(iter(self._heard))]
        if kind == reader.of.kind:
            heard.own = min(heard.own, stamp)
            return stamp not in heard.others
        if stamp >= heard.own or stamp in heard.others:
            return False
        heard.others[stamp] = None
        if len(heard.others) > QUEUE:
            del heard.others[next(iter(heard.others))]
        return True

    def _count_losses(self) -> None:
        for reader in self._readers.values():
            lost = reader.entity.get_sample_lost_status().total_count
            self.messages.refuse("message lost by DDS", reader.of.topic, lost - reader.lost)
            reader.lost = lost
        for topic, count in list(self.network.unread.items()):
            name = ros_topic(topic) or "a packet that is not DDS"
            self.messages.refuse("malformed payload (DDS)", name, count - self._unread.get(topic, 0))
            self._unread[topic] = count

    def _say_what_is_missing(self, age: float) -> None:
        now = time.monotonic()
        if age > LONELY:
            self.choice.warn_of_absent({p.topic: p.type for p in self._publications}, self.ledger)
        if age > LONELY and not self._readers:
            more = f"; --interface {AUTO} searches the network; docs/live.md has a CYCLONEDDS_URI for ROS nodes on loopback"
            hint = more if self.network.where == LOOPBACK else ""
            where = f"{self.network.where}, domain {self.network.domain}{hint}"
            self.ledger.warn(f"no publisher of odometry, tf or detections on {where}")
        for reader in self._readers.values():
            # No reader is matched with the session's own publishers.
            others = (p for p in self._publications if not p.own)
            present = any((p.topic, p.kind) == (reader.of.topic, reader.of.kind) for p in others)
            if not reader.warned and present and now - reader.since > LONELY:
                reader.warned = True
                if not reader.entity.get_matched_publications():
                    self.ledger.warn(
                        f"{reader.of.topic}: the publisher has another QoS or another layout of {reader.of.type}"
                    )


def _kind(qos: Any, type_: str) -> Kind:
    from cyclonedds.core import Policy

    reliable = isinstance(qos[Policy.Reliability], Policy.Reliability.Reliable) if Policy.Reliability in qos else False
    volatile = qos[Policy.Durability] == Policy.Durability.Volatile if Policy.Durability in qos else True
    return reliable, not volatile and type_ in LATCHED
