"""Joins DDS domains on a chosen network, and counts the payloads that the DDS library rejects."""

import atexit
import ctypes
import ipaddress
import os
import re
import socket
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from objslam.errors import ConfigError, ObjslamError
from objslam.io.threads import start_thread

LOOPBACK, AUTO = "loopback", "auto"
_URI, _DOMAIN_ID = "CYCLONEDDS_URI", "ROS_DOMAIN_ID"
_MAX_DOMAIN = 232  # The largest number of a DDS domain, because larger numbers have no ports.
_BUFFER = "4MB"  # The requested socket buffer. It holds a raw image, which arrives as a burst of fragments.
_FAILED = re.compile(r"deserialization (\S+) failed")
_MALFORMED = re.compile(r"malformed packet")


@dataclass
class Network:
    """A DDS domain that this process has joined.

    where: the network, in words. entities: DDS entities that must live as long as the participant. unread: the number of
    payloads that the library rejected, by DDS topic. The topic "" counts packets that are not DDS.
    """

    domain: int
    where: str
    participant: Any
    entities: tuple[Any, ...]
    unread: Counter[str] = field(default_factory=Counter)


_OPEN: dict[int, tuple[str | None, Network]] = {}


def open_network(domain: int | None = None, interface: str | None = None) -> Network:
    """Join a DDS domain, or return the network of a domain that the process has already joined.

    domain: the number of the domain. None takes ROS_DOMAIN_ID, or 0 if this variable is unset. interface: the name or
    address of an interface, or "auto" for any. None takes CYCLONEDDS_URI, or loopback if this variable is unset. Raises
    ObjslamError if cyclonedds is not installed or the domain cannot be joined, and ConfigError if an argument is invalid, or
    the domain is already open on another interface.
    """
    try:
        with _without_stderr():
            import cyclonedds.domain  # noqa: F401
    except ImportError as error:
        raise ObjslamError("cyclonedds is not installed", hint='pip install "objslam[dds]"') from error
    domain = _domain(domain)
    if domain in _OPEN:
        asked, network = _OPEN[domain]
        if asked != interface:
            raise ConfigError(f"DDS domain {domain} is open on {network.where} already")
        return network
    _OPEN[domain] = interface, _join(domain, interface)
    return _OPEN[domain][1]


def _domain(given: int | None) -> int:
    text = os.environ.get(_DOMAIN_ID, "0") if given is None else str(given)
    if not (text.isascii() and text.isdigit() and int(text) <= _MAX_DOMAIN):
        where = _DOMAIN_ID if given is None else "--domain"
        raise ConfigError(f"{text[:20]!r} is no DDS domain", where=where, hint=f"give a number from 0 to {_MAX_DOMAIN}")
    return int(text)


def _join(domain: int, interface: str | None) -> Network:
    from cyclonedds.core import DDSException
    from cyclonedds.domain import Domain, DomainParticipant

    where, settings = _settings(interface)
    reading, writing = os.pipe()
    trace = f"<Tracing><Verbosity>warning</Verbosity><OutputFile>/dev/fd/{writing}</OutputFile></Tracing>"
    buffer = f'<Internal><SocketReceiveBufferSize min="default" max="{_BUFFER}"/></Internal>'
    own = f"<CycloneDDS><Domain>{trace}{settings if where != _URI else ''}{buffer}</Domain></CycloneDDS>"
    before = _sockets()
    try:
        with _without_stderr():
            entity = Domain(domain, f"{settings},{own}" if where == _URI else own)
        if where == LOOPBACK:
            _keep_inside(_sockets() - before)
        participant = DomainParticipant(domain)
    except DDSException as error:
        os.close(reading)
        hint = f"check {_URI}" if where == _URI else "choose --interface from the list of `ip address`"
        raise ObjslamError(f"DDS domain {domain} cannot be joined on {where}", hint=hint) from error
    finally:
        os.close(writing)
    network = Network(domain, where, participant, (entity,))
    atexit.register(_leave, entity)
    start_thread(threading.Thread(target=_listen, args=(reading, network.unread), name="dds-log", daemon=True))
    return network


def _leave(entity: Any) -> None:
    """Leave a domain with all its entities, before the interpreter ends.

    Threads of the DDS library release Python's types. A thread that asks for the interpreter while the interpreter ends is
    stopped for ever. The library would wait for this thread, and so the process would never end. The domain must be left
    while the thread of `_listen` still reads the log of the library. Without this thread, a flood of malformed packets would
    fill the pipe of the log, and the library would wait.
    """
    entity.__del__()  # The binding offers no other way to delete an entity. A second call does nothing.


@contextmanager
def _without_stderr() -> Iterator[None]:
    """Hide C's `stderr` while the DDS library is imported and opens a domain. Later, the library still writes to the hidden
    file.

    Otherwise the library would write a line to the terminal for each malformed packet from the network, although `_listen`
    already counts the packet. The library has no setting for this. Python itself does not write to C's `stderr`, but to its
    descriptor. If the system has no such variable, the warnings are printed.
    """
    system = ctypes.CDLL(None)
    try:
        stderr = ctypes.c_void_p.in_dll(system, "stderr")
    except ValueError:  # This system has no variable of this name.
        yield
        return
    system.fopen.restype = ctypes.c_void_p
    kept, nowhere = stderr.value, system.fopen(os.devnull.encode(), b"w")
    stderr.value = nowhere or kept
    try:
        yield
    finally:
        stderr.value = kept


def _settings(interface: str | None) -> tuple[str, str]:
    """Return the network in words, and the library's settings for it."""
    if interface is None and os.environ.get(_URI):
        return _URI, os.environ[_URI]
    if interface in (None, LOOPBACK):
        # A loopback interface may lack multicast. So participants are searched for at the ports of all participant indices.
        peers = '<Peers><Peer address="127.0.0.1"/></Peers>'
        index = "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>99</MaxAutoParticipantIndex>"
        chosen = '<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces><AllowMulticast>false</AllowMulticast>'
        return LOOPBACK, f"<General>{chosen}</General><Discovery>{index}{peers}</Discovery>"
    assert interface is not None
    if interface == AUTO:
        return "the network", ""
    try:
        named = f'address="{ipaddress.ip_address(interface)}"'
    except ValueError:
        if not re.fullmatch(r"[A-Za-z0-9_.:@-]{1,32}", interface):
            hint = "choose from the list of `ip address`"
            raise ConfigError(f"{interface[:40]!r} is not a network interface", where="--interface", hint=hint) from None
        named = f'name="{interface}"'
    return f"the interface {interface}", f"<General><Interfaces><NetworkInterface {named}/></Interfaces></General>"


def _sockets() -> set[int]:
    """Return this process's file descriptors that are sockets. The set is empty if the system does not list them."""
    found = set()
    folder = Path("/proc/self/fd")
    for entry in folder.iterdir() if folder.is_dir() else ():
        try:
            if str(entry.readlink()).startswith("socket:"):
                found.add(int(entry.name))
        except OSError:  # The descriptor that listed the folder is already closed.
            continue
    return found


def _keep_inside(sockets: set[int]) -> None:
    """Bind sockets to the loopback device, because the library makes them listen on the addresses of all interfaces."""
    for number in sockets:
        with socket.socket(fileno=os.dup(number)) as own:
            if own.type == socket.SOCK_DGRAM:
                try:
                    own.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")
                except OSError as error:  # Before Linux 5.7, this needs a privilege.
                    raise ObjslamError(
                        f"the DDS sockets cannot be bound to the loopback interface ({error.strerror})",
                        hint=f"open them to the network with --interface {AUTO}",
                    ) from error


def _listen(reading: int, unread: Counter[str]) -> None:
    """Count the payloads that the library rejects, from its log. reading: the file descriptor of a pipe with this log."""
    with os.fdopen(reading, errors="replace") as lines:
        for line in lines:
            if match := _FAILED.search(line):
                unread[match[1].rpartition("/")[0]] += 1  # The text is topic/type, and only the topic counts.
            elif _MALFORMED.search(line):
                unread[""] += 1


def receive_buffer() -> int | None:
    """Return the size in bytes of the largest socket buffer that the system allows, or None if it is unknown."""
    try:
        return int(Path("/proc/sys/net/core/rmem_max").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None
