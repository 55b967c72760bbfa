"""A running ROS 2 robot, heard over DDS without a ROS install."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import Any

from objslam.core.diagnostics import Ledger
from objslam.live.dds.network import AUTO, LOOPBACK, Network, receive_buffer
from objslam.live.dds.types import dds_topic, layouts_of, ros_topic, ros_type
from objslam.live.ros.message_handler import RosMessages
from objslam.live.ros.topic_discovery import HEAD_START, LOOK_EVERY, QUEUE, STOP_WAIT, TopicChoice
from objslam.ros.bag.records import Connection, plain
from objslam.ros.messages.decode import DecodeError, make_decoder
from objslam.ros.messages.topic_types import IMAGES, LATCHED

_LONELY = 5.0  # Time without any publisher, or with one that does not match, before that is said, s.
_TAKE = 200  # The messages that are taken of a reader at once; larger: other topics wait longer.
_MAX_READERS = 256  # The most readers that are open; chosen to bound the memory.
_MIN_BUFFER = 2 << 20  # The smallest socket buffer that a raw image fits into, bytes; below it a warning is given.

_Kind = tuple[bool, bool]
"""Whether a writer is reliable, and whether it keeps past messages (transient-local)."""


@dataclass
class _Publication:
    topic: str
    type: str
    kind: _Kind
    type_id: Any


@dataclass
class _Reader:
    """A DDS reader of a topic, for writers of one kind."""

    topic: str
    type: str
    kind: _Kind
    entity: Any
    decode: Any
    since: float
    lost: int = 0
    told: bool = False


@dataclass
class DdsAdapter:
    """Hears topics by their types, as their publishers come and go, and hands the messages on.

    For each topic there is a reader for each kind of publisher, best-effort or reliable, volatile or transient-local: a
    reader that asks for more than is offered hears nothing, one that asks for less may lose what need not be lost.
    """

    network: Network
    messages: RosMessages
    choice: TopicChoice
    _publications: dict[int, _Publication] = field(default_factory=dict)
    _readers: dict[tuple[str, _Kind], _Reader] = field(default_factory=dict)
    _topics: dict[str, Any] = field(default_factory=dict)
    _unread: dict[str, int] = field(default_factory=dict)

    @property
    def ledger(self) -> Ledger:
        """What was dropped before it could be pushed, and warnings."""
        return self.messages.ledger

    def run(self, stop: threading.Event) -> None:
        """Hand messages on until stop is set."""
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
        """Note which publishers there are."""
        from cyclonedds.core import InstanceState

        while samples := found.take(_TAKE):
            for sample in samples:
                handle = sample.sample_info.instance_handle
                if sample.sample_info.instance_state != InstanceState.Alive or not sample.sample_info.valid_data:
                    self._publications.pop(handle, None)
                    continue
                topic, type_ = ros_topic(sample.topic_name), ros_type(sample.type_name)
                if topic is not None and type_ is not None:
                    publication = _Publication(plain(topic), type_, _kind(sample.qos, type_), sample.type_id)
                    self._publications[handle] = publication

    def _open(self, age: float) -> list[_Reader]:
        """Make the readers that are missing for what is published and wanted."""
        offered = {publication.topic: publication.type for publication in self._publications.values()}
        wanted = self.choice.wanted(offered, self.messages, settled=age >= HEAD_START)
        opened = []
        for publication in list(self._publications.values()):
            key = publication.topic, publication.kind
            fits = publication.topic in wanted and publication.type == offered[publication.topic]
            if fits and key not in self._readers and len(self._readers) < _MAX_READERS:
                reader = self._make_reader(publication)
                if reader is not None:
                    self._readers[key] = reader
                    opened.append(reader)
        order = {type_: rank for rank, type_ in enumerate(LATCHED)}  # frames and cameras before what refers to them
        self._readers = dict(sorted(self._readers.items(), key=lambda item: order.get(item[1].type, len(order))))
        return opened

    def _make_reader(self, publication: _Publication) -> _Reader | None:
        from cyclonedds.core import DDSException, Policy, Qos
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        topic, type_, (reliable, latched) = publication.topic, publication.type, publication.kind
        layouts = layouts_of(type_)
        if not layouts:
            self.ledger.warn(f"{topic}: its type {type_} is not known, and DDS does not bring definitions: left out")
            return None
        layout = next((layout for layout in layouts if _is_of(publication, layout)), layouts[0])
        images = type_ in IMAGES
        qos = Qos(
            Policy.Reliability.Reliable(0) if reliable else Policy.Reliability.BestEffort,
            Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
            Policy.History.KeepLast(1 if images else QUEUE),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        if images and (receive_buffer() or _MIN_BUFFER) < _MIN_BUFFER:
            self.ledger.warn("the system's socket buffers are small for images: sysctl -w net.core.rmem_max=4194304")
        try:
            if topic not in self._topics:
                self._topics[topic] = Topic(self.network.participant, dds_topic(topic), layout)
            entity: Any = DataReader(self.network.participant, self._topics[topic], qos=qos)
        except DDSException as error:
            self.ledger.warn(f"{topic}: cannot be heard ({error.msg})")
            return None
        decode = make_decoder(Connection(topic, type_, "cdr"))
        return _Reader(topic, type_, publication.kind, entity, decode, time.monotonic())

    def _take(self, reader: _Reader, found: Any) -> None:
        """Hand on what a reader has; no more than it may hold, so that one that never runs dry does not keep off a stop."""
        for _ in range(QUEUE // _TAKE):
            samples = reader.entity.take(_TAKE)
            for sample in samples:
                info = sample.sample_info
                if not info.valid_data or not self._is_mine(reader, info.publication_handle, found):
                    continue
                try:
                    message = reader.decode(sample.data)
                except DecodeError as error:
                    self.messages.refuse("message that cannot be decoded", f"{reader.topic}: {error}")
                    continue
                self.messages.receive(reader.type, reader.topic, message, info.source_timestamp / 1e9)
            if len(samples) < _TAKE:
                return

    def _is_mine(self, reader: _Reader, handle: int, found: Any) -> bool:
        """Whether a reader takes what a publisher sent: a best-effort one hears the reliable publishers too."""
        if handle not in self._publications:
            self._look_around(found)
        publication = self._publications.get(handle)
        if publication is not None:
            return publication.kind == reader.kind
        alone = sum(topic == reader.topic for topic, _ in self._readers) == 1
        return alone or reader.kind == max(kind for topic, kind in self._readers if topic == reader.topic)

    def _count_losses(self) -> None:
        for reader in self._readers.values():
            lost = reader.entity.get_sample_lost_status().total_count
            self.messages.refuse("message lost on the way (DDS)", reader.topic, lost - reader.lost)
            reader.lost = lost
        for topic, count in list(self.network.unread.items()):
            name = ros_topic(topic) or "a packet that is not DDS"
            self.messages.refuse("malformed payload (DDS)", name, count - self._unread.get(topic, 0))
            self._unread[topic] = count

    def _say_what_is_missing(self, age: float) -> None:
        now = time.monotonic()
        if age > _LONELY and not self._readers:
            hint = f"; --interface {AUTO} looks on the network" if self.network.where == LOOPBACK else ""
            self.ledger.warn(
                f"no publisher of odometry, tf or detections on {self.network.where}, domain {self.network.domain}{hint}"
            )
        for reader in self._readers.values():
            present = any((p.topic, p.kind) == (reader.topic, reader.kind) for p in self._publications.values())
            if not reader.told and present and now - reader.since > _LONELY:
                reader.told = True
                if not reader.entity.get_matched_publications():
                    self.ledger.warn(
                        f"{reader.topic}: there is a publisher, but its QoS or layout of {reader.type} does not match"
                    )


def _is_of(publication: _Publication, layout: Any) -> bool:
    """Whether a publisher says that its messages have this layout; older ones do not say."""
    return publication.type_id is not None and layout.__idl__.get_type_id() == publication.type_id


def _kind(qos: Any, type_: str) -> _Kind:
    from cyclonedds.core import Policy

    reliable = isinstance(qos[Policy.Reliability], Policy.Reliability.Reliable) if Policy.Reliability in qos else False
    volatile = qos[Policy.Durability] == Policy.Durability.Volatile if Policy.Durability in qos else True
    return reliable, not volatile and type_ in LATCHED
