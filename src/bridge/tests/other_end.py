#!/usr/bin/env python3
"""The other end of the bridge, by Eclipse Cyclone DDS: what a node of ROS 2 with rmw_cyclonedds hears.

Subscribes to the bridge's topics in DDS domain DOMAIN, prints `ready` and then one JSON line for each message until its stdin
closes. Messages are declared here from the .msg files of ROS, apart from the bridge's own declarations.

usage: other_end.py DOMAIN [--only TOPIC]
"""

import json
import os
import sys
import threading
import time
from dataclasses import dataclass

PEERS = """<CycloneDDS><Domain id="any"><General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
<AllowMulticast>false</AllowMulticast><MaxMessageSize>65500B</MaxMessageSize></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""
os.environ.setdefault("CYCLONEDDS_URI", PEERS)

from cyclonedds.core import InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet  # noqa: E402
from cyclonedds.domain import DomainParticipant  # noqa: E402
from cyclonedds.idl import IdlStruct  # noqa: E402
from cyclonedds.idl.types import array, float64, int32, sequence, uint8, uint32  # noqa: E402
from cyclonedds.sub import DataReader  # noqa: E402
from cyclonedds.topic import Topic  # noqa: E402
from cyclonedds.util import duration  # noqa: E402


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    position: Point
    orientation: Quaternion


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovariance_"):
    pose: Pose
    covariance: array[float64, 36]


@dataclass
class Twist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
    linear: Vector3
    angular: Vector3


@dataclass
class TwistWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::TwistWithCovariance_"):
    twist: Twist
    covariance: array[float64, 36]


@dataclass
class Odometry(IdlStruct, typename="nav_msgs::msg::dds_::Odometry_"):
    header: Header
    child_frame_id: str
    pose: PoseWithCovariance
    twist: TwistWithCovariance


@dataclass
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    transforms: sequence[TransformStamped]


@dataclass
class PointField(IdlStruct, typename="sensor_msgs::msg::dds_::PointField_"):
    name: str
    offset: uint32
    datatype: uint8
    count: uint32


@dataclass
class PointCloud2(IdlStruct, typename="sensor_msgs::msg::dds_::PointCloud2_"):
    header: Header
    height: uint32
    width: uint32
    fields: sequence[PointField]
    is_bigendian: bool
    point_step: uint32
    row_step: uint32
    data: sequence[uint8]
    is_dense: bool


@dataclass
class KeyValue(IdlStruct, typename="diagnostic_msgs::msg::dds_::KeyValue_"):
    key: str
    value: str


@dataclass
class DiagnosticStatus(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticStatus_"):
    level: uint8
    name: str
    message: str
    hardware_id: str
    values: sequence[KeyValue]


@dataclass
class DiagnosticArray(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticArray_"):
    header: Header
    status: sequence[DiagnosticStatus]


def numbers(value):
    """The fields of a message, innermost first to last, as a flat list."""
    if isinstance(value, (list, tuple)):
        return [n for item in value for n in numbers(item)]
    if hasattr(value, "__dataclass_fields__"):
        return [n for name in value.__dataclass_fields__ for n in numbers(getattr(value, name))]
    return [value]


def stamp(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def told(topic, m, now):
    """A message as a JSON object."""
    if topic == "odometry":
        return dict(stamp=stamp(m.header), frame=m.header.frame_id, child=m.child_frame_id, now=now,
                    pose=numbers(m.pose.pose), pose_covariance=list(m.pose.covariance),
                    twist=numbers(m.twist.twist), twist_covariance=list(m.twist.covariance))
    if topic == "tf":
        return [dict(stamp=stamp(t.header), frame=t.header.frame_id, child=t.child_frame_id, pose=numbers(t.transform))
                for t in m.transforms]
    if topic == "map":
        data = bytes(m.data)
        return dict(stamp=stamp(m.header), frame=m.header.frame_id, height=m.height, width=m.width, step=m.point_step,
                    row=m.row_step, big=m.is_bigendian, dense=m.is_dense, fields=[numbers(f) for f in m.fields],
                    data=data.hex(), now=now)
    return [dict(level=s.level, name=s.name, message=s.message, hardware=s.hardware_id,
                 values={v.key: v.value for v in s.values}, stamp=stamp(m.header)) for s in m.status]


TOPICS = dict(odometry=("rt/stipple/odometry", Odometry, False), tf=("rt/tf", TFMessage, False),
              map=("rt/stipple/map", PointCloud2, True), diagnostics=("rt/diagnostics", DiagnosticArray, False))


def main():
    participant = DomainParticipant(int(sys.argv[1]))
    wanted = sys.argv[3:] if "--only" in sys.argv else list(TOPICS)
    readers = {}
    waiting = WaitSet(participant)
    for name in wanted:
        topic, kind, keeps = TOPICS[name]
        durability = Policy.Durability.TransientLocal if keeps else Policy.Durability.Volatile
        qos = Qos(Policy.Reliability.Reliable(duration(seconds=1)), durability, Policy.History.KeepAll)
        readers[name] = DataReader(participant, Topic(participant, topic, kind), qos=qos)
        waiting.attach(ReadCondition(readers[name], SampleState.NotRead | ViewState.Any | InstanceState.Any))
    print("ready", flush=True)
    threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0)), daemon=True).start()
    while True:
        waiting.wait(duration(milliseconds=500))
        for name, reader in readers.items():
            for sample in reader.take(N=100):
                if sample.sample_info.valid_data:
                    print(json.dumps({"topic": name, "message": told(name, sample, time.time_ns())}), flush=True)


main()
