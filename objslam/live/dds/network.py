"""The way into a DDS domain: which network it may use, and what the library says of what it could not read."""

from __future__ import annotations

import ipaddress
import os
import re
import socket
import threading
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from objslam.errors import ConfigError, ObjslamError

LOOPBACK, AUTO = "loopback", "auto"
_URI, _DOMAIN_ID = "CYCLONEDDS_URI", "ROS_DOMAIN_ID"
_MAX_DOMAIN = 232  # The largest domain that DDS has ports for.
_BUFFER = "4MB"  # The socket buffer that is asked for; chosen for a raw image, which comes as a burst of fragments.
_FAILED = re.compile(r"deserialization (\S+) failed")
_MALFORMED = re.compile(r"malformed packet")
_DEVICE = b"lo\0"  # The loopback device.


@dataclass
class Network:
    """One domain of this process: the participant, what network it is on, in words, and what could not be read.

    unread: by DDS topic ("" for what is no DDS at all), how many payloads the library threw away.
    """

    domain: int
    where: str
    participant: Any
    entities: tuple[Any, ...]
    unread: Counter[str] = field(default_factory=Counter)


_OPEN: dict[int, tuple[str | None, Network]] = {}


def open_network(domain: int | None = None, interface: str | None = None) -> Network:
    """Join a DDS domain; a process joins each once, and gets the same again.

    domain: None for that of ROS_DOMAIN_ID, else 0. interface: None for what CYCLONEDDS_URI says, else the loopback
    interface alone; "auto", a name or an address opens the network. ObjslamError where cyclonedds is not installed or the
    domain cannot be joined; ConfigError for a domain or an interface that cannot be.
    """
    try:
        import cyclonedds  # noqa: F401
    except ImportError as error:
        raise ObjslamError("cyclonedds is not installed", hint='pip install "objslam[dds]"') from error
    domain = _domain(domain)
    if domain in _OPEN:
        asked, network = _OPEN[domain]
        if asked != interface:
            raise ConfigError(f"DDS domain {domain} is open on {network.where} already")
        return network
    network = _join(domain, interface)
    _OPEN[domain] = interface, network
    return network


def _domain(given: int | None) -> int:
    text = os.environ.get(_DOMAIN_ID, "0") if given is None else str(given)
    if not (text.isascii() and text.isdigit() and int(text) <= _MAX_DOMAIN):
        where = _DOMAIN_ID if given is None else "--domain"
        raise ConfigError(f"{text[:20]!r} is no DDS domain", where=where, hint=f"0 to {_MAX_DOMAIN}")
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
        entity = Domain(domain, f"{settings},{own}" if where == _URI else own)
        if where == LOOPBACK:
            _keep_inside(_sockets() - before)
        participant = DomainParticipant(domain)
    except DDSException as error:
        os.close(reading)
        hint = f"{_URI} is set" if where == _URI else "--interface names the network interface, `ip address` lists them"
        raise ObjslamError(f"DDS domain {domain} cannot be joined on {where}", hint=hint) from error
    finally:
        os.close(writing)
    network = Network(domain, where, participant, (entity,))
    threading.Thread(target=_listen, args=(reading, network.unread), name="dds-log", daemon=True).start()
    return network


def _settings(interface: str | None) -> tuple[str, str]:
    """Where the domain is, in words, and the library's settings for it."""
    if interface is None and os.environ.get(_URI):
        return _URI, os.environ[_URI]
    if interface in (None, LOOPBACK):
        # without multicast, which a loopback interface need not have, others are found at the ports of their index
        peers = '<Peers><Peer address="127.0.0.1"/></Peers>'
        index = "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>99</MaxAutoParticipantIndex>"
        chosen = '<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces><AllowMulticast>false</AllowMulticast>'
        return LOOPBACK, f"<General>{chosen}</General><Discovery>{index}{peers}</Discovery>"
    assert interface is not None
    if interface == AUTO:
        return "the network", ""
    return (
        f"the interface {interface}",
        f"<General><Interfaces><NetworkInterface {_named(interface)}/></Interfaces></General>",
    )


def _named(interface: str) -> str:
    try:
        return f'address="{ipaddress.ip_address(interface)}"'
    except ValueError:
        if not re.fullmatch(r"[A-Za-z0-9_.:@-]{1,32}", interface):
            raise ConfigError(f"{interface[:40]!r} is no network interface", where="--interface") from None
        return f'name="{interface}"'


def _sockets() -> set[int]:
    """The file descriptors of this process that are sockets; none where the system does not list them."""
    found = set()
    folder = Path("/proc/self/fd")
    for entry in folder.iterdir() if folder.is_dir() else ():
        try:
            if str(entry.readlink()).startswith("socket:"):
                found.add(int(entry.name))
        except OSError:  # the one that listed the folder is closed by now
            continue
    return found


def _keep_inside(sockets: set[int]) -> None:
    """Bind sockets to the loopback device: the library listens on every address whatever interface it is given."""
    for number in sockets:
        with socket.socket(fileno=os.dup(number)) as own:
            if own.type == socket.SOCK_DGRAM:
                try:
                    own.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, _DEVICE)
                except OSError as error:  # a kernel before 5.7, without the right to
                    raise ObjslamError(
                        f"the DDS sockets cannot be kept to the loopback interface ({error.strerror})",
                        hint=f"--interface {AUTO} opens them to the network",
                    ) from error


def _listen(reading: int, unread: Counter[str]) -> None:
    """Count what the library throws away: it checks payloads against their type before anyone sees them."""
    with os.fdopen(reading, errors="replace") as lines:
        for line in lines:
            if match := _FAILED.search(line):
                unread[match[1].rpartition("/")[0]] += 1  # topic/type
            elif _MALFORMED.search(line):
                unread[""] += 1


def receive_buffer() -> int | None:
    """The largest socket buffer that the system grants, bytes; None where it does not say."""
    try:
        return int(Path("/proc/sys/net/core/rmem_max").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None
