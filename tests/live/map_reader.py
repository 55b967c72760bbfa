"""A reader of a published map, in a process of its own: python map_reader.py DOMAIN. It prints the x of the first object."""

import sys

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from test_publish import written_types
from waiting import pause

participant = DomainParticipant(int(sys.argv[1]))
qos = Qos(Policy.Reliability.Reliable(0), Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
reader = DataReader(participant, Topic(participant, "rt/objslam/objects", written_types()["Detection3DArray"]), qos=qos)
while True:
    for found in reader.take(1):
        sys.stdout.write(f"{found.detections[0].results[0].pose.pose.position.x}\n")
        sys.stdout.flush()
    pause(0.01)
