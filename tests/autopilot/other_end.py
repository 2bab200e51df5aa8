#!/usr/bin/env python3
"""The other end of the link to an autopilot, by pymavlink, with models of what PX4 and ArduPilot do with odometry.

Prints `ready LINK`, where LINK is what mavlink.link is to be, then listens for SECONDS and prints one JSON object.

usage: other_end.py udp|serial SECONDS [--baud B] [--ages] [--states] [--malformed N] [--cut FROM TO] [--stall FROM TO]

  --malformed N    send N damaged messages, spread over the time
  --cut FROM TO    close the link from then to then, s: a cable that is unplugged
  --stall FROM TO  read nothing from then to then
"""

import argparse
import json
import math
import os
import pty
import random
import select
import socket
import tempfile
import time
import tty

from pymavlink.dialects.v20 import common as m

# PX4, EKF2: EV_MAX_INTERVAL and the time without data after which it stops fusing, s.
PX4_GAP, PX4_STOP = 0.2, 0.4
# ArduPilot: AP_VISUALODOM_TIMEOUT_MS, s.
ARDUPILOT_TIMEOUT = 0.3


class Gates:
    """What each autopilot makes of the states it gets."""

    def __init__(self):
        self.px4 = dict(fused=0, refused=0, gaps=0, stops=0, longest_gap=0.0)
        self.ardupilot = dict(taken=0, refused=0, unhealthy=0)
        self.last_px4 = self.last_ardupilot = self.last_stamp = None

    def take(self, now, o):
        numbers = [o.x, o.y, o.z, *o.q, o.vx, o.vy, o.vz]
        finite = all(math.isfinite(n) for n in numbers)
        unit = abs(math.sqrt(sum(n * n for n in o.q)) - 1) < 0.01
        known = o.frame_id in (m.MAV_FRAME_LOCAL_NED, m.MAV_FRAME_LOCAL_FRD) and o.child_frame_id in (
            m.MAV_FRAME_LOCAL_NED, m.MAV_FRAME_LOCAL_FRD, m.MAV_FRAME_BODY_FRD)
        kind = o.estimator_type in (m.MAV_ESTIMATOR_TYPE_VISION, m.MAV_ESTIMATOR_TYPE_VIO)
        newer = self.last_stamp is None or o.time_usec > self.last_stamp
        self.last_stamp = o.time_usec
        if finite and unit and known and kind and newer and o.quality >= 0:
            if self.last_px4 is not None:
                gap = now - self.last_px4
                self.px4["gaps"] += gap > PX4_GAP
                self.px4["stops"] += gap > PX4_STOP
                self.px4["longest_gap"] = max(self.px4["longest_gap"], gap)
            self.last_px4 = now
            self.px4["fused"] += 1
        else:
            self.px4["refused"] += 1
        if (o.frame_id, o.child_frame_id) == (m.MAV_FRAME_LOCAL_FRD, m.MAV_FRAME_BODY_FRD) and finite and o.quality >= 0:
            if self.last_ardupilot is not None:
                self.ardupilot["unhealthy"] += now - self.last_ardupilot > ARDUPILOT_TIMEOUT
            self.last_ardupilot = now
            self.ardupilot["taken"] += 1
        else:
            self.ardupilot["refused"] += 1


class Line:
    """A UDP socket, or a pseudo-terminal that is read as fast as a UART of so many baud gives bytes."""

    def __init__(self, kind, baud):
        self.baud, self.free = baud, time.monotonic()
        if kind == "udp":
            self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self.socket.bind(("127.0.0.1", 0))
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
            self.fd, self.peer = self.socket.fileno(), None
            self.name = "udpout:127.0.0.1:%d" % self.socket.getsockname()[1]
        else:
            self.socket = None
            self.fd, slave = pty.openpty()
            tty.setraw(slave)
            os.set_blocking(self.fd, False)
            # A name that stays, since what is unplugged gets another one.
            self.path = os.path.join(tempfile.mkdtemp(), "uart")
            os.symlink(os.ttyname(slave), self.path)
            os.close(slave)
            self.name = "serial:%s:%d" % (self.path, baud)

    def read(self, wait):
        readable, _, _ = select.select([self.fd], [], [], wait)
        now = time.monotonic()
        if not readable:
            self.free = now
            return b""
        if self.socket:
            data, self.peer = self.socket.recvfrom(4096)
            return data
        # A UART sends while nobody looks: a late reader finds all that its line carried since the last byte, and no more.
        time.sleep(max(0.0, self.free + 0.001 - now))
        now = time.monotonic()
        carried = max(1, int((now - self.free) * self.baud / 10.0))
        try:
            data = os.read(self.fd, min(carried, 1 << 16))
        except OSError:
            # Nobody has the line open.
            time.sleep(wait)
            self.free = time.monotonic()
            return b""
        # A line that had less to carry was idle.
        self.free = now if len(data) < carried else self.free + 10.0 * len(data) / self.baud
        return data

    def write(self, data):
        try:
            if not self.socket:
                os.write(self.fd, data)
            elif self.peer:
                self.socket.sendto(data, self.peer)
        except OSError:
            pass

    def cut(self):
        if self.socket:
            port = self.socket.getsockname()[1]
            self.socket.close()
            return port
        os.unlink(self.path)
        os.close(self.fd)
        return None

    def mend(self, port):
        if port:
            self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self.socket.bind(("127.0.0.1", port))
            self.fd, self.peer = self.socket.fileno(), None
            return
        self.fd, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(self.fd, False)
        os.symlink(os.ttyname(slave), self.path)
        os.close(slave)


def damaged(draw, sender):
    """A message that no parser may take for one: cut, with a changed byte, or not one at all."""
    messages = [
        sender.heartbeat_encode(2, 12, 0, 0, 3),
        sender.timesync_encode(0, draw.getrandbits(62)),
        sender.statustext_encode(6, b"damaged"),
    ]
    packed = bytearray(draw.choice(messages).pack(sender))
    way = draw.randrange(3)
    if way == 0:
        return bytes(packed[: draw.randrange(1, len(packed))])
    if way == 1:
        # Not in the id: of another message, this end could not know it.
        at = draw.choice([i for i in range(1, len(packed)) if i not in (7, 8, 9)])
        packed[at] ^= 1 << draw.randrange(8)
        return bytes(packed)
    return bytes(draw.getrandbits(8) for _ in range(draw.randrange(1, 300)))


def percentile(values, part):
    return sorted(values)[min(len(values) - 1, int(part * len(values)))] if values else None


def has_nan(message):
    fields = [getattr(message, name) for name in message.get_fieldnames()]
    flat = [n for f in fields for n in (f if isinstance(f, (list, tuple)) else [f])]
    return any(isinstance(n, float) and not math.isfinite(n) for n in flat)


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("kind", choices=["udp", "serial"])
    arguments.add_argument("seconds", type=float)
    arguments.add_argument("--baud", type=int, default=921600)
    arguments.add_argument("--malformed", type=int, default=0)
    arguments.add_argument("--ages", action="store_true", help="give every age, too")
    arguments.add_argument("--states", action="store_true", help="give every state, too")
    for fault in ("--cut", "--stall"):
        arguments.add_argument(fault, type=float, nargs=2, default=(math.inf, math.inf))
    a = arguments.parse_args()
    line, gates, draw = Line(a.kind, a.baud), Gates(), random.Random(1)
    sender = m.MAVLink(None, srcSystem=1, srcComponent=1)
    parser = m.MAVLink(None)
    parser.robust_parsing = True
    counts, texts, ages, states, resets, pending = {}, [], [], [], [], {}
    sequence, lost, nan, bad, vision = None, 0, 0, 0, 0
    offsets, rounds, heartbeats = [], [], []
    print("ready", line.name, flush=True)
    # The time begins with what comes first.
    begun, beat, sync, sent, port, is_cut = None, 0.0, 0.0, 0, None, False
    opened = time.monotonic()
    while True:
        now = time.monotonic()
        t = 0.0 if begun is None else now - begun
        if t > a.seconds or begun is None and now - opened > 120:
            break
        if a.cut[0] <= t < a.cut[1]:
            if not is_cut:
                port, is_cut = line.cut(), True
            time.sleep(0.01)
            continue
        if is_cut:
            line.mend(port)
            is_cut, sequence = False, None
        if a.stall[0] <= t < a.stall[1]:
            time.sleep(0.01)
            continue
        data = line.read(0.002)
        now = time.monotonic()
        if begun is None and data:
            begun = now
        for message in (parser.parse_buffer(data) or []) if data else []:
            kind = message.get_type()
            if kind == "BAD_DATA":
                bad += 1
                continue
            counts[kind] = counts.get(kind, 0) + 1
            got = message.get_seq()
            if sequence is not None:
                lost += (got - sequence - 1) % 256
            sequence = got
            nan += has_nan(message)
            if kind == "ODOMETRY":
                gates.take(now, message)
                ages.append(1e3 * now - message.time_usec / 1e3)
                if not resets or resets[-1] != message.reset_counter:
                    resets.append(message.reset_counter)
                if a.states:
                    o = message
                    states.append([o.time_usec, o.x, o.y, o.z, *o.q, o.vx, o.vy, o.vz, o.quality, o.reset_counter])
            elif kind == "VISION_POSITION_ESTIMATE":
                ages.append(1e3 * now - message.usec / 1e3)
                vision += 1
            elif kind == "STATUSTEXT":
                text = message.text if isinstance(message.text, str) else bytes(message.text).split(b"\0")[0].decode()
                if message.id == 0:
                    texts.append([message.severity, text])
                else:
                    pending[message.id] = pending.get(message.id, "") + text
                    if len(text) < 50:
                        texts.append([message.severity, pending.pop(message.id)])
            elif kind == "HEARTBEAT":
                heartbeats.append([now - begun, message.type, message.autopilot, message.system_status])
            elif kind == "TIMESYNC" and message.tc1 == 0:
                line.write(sender.timesync_encode(time.monotonic_ns(), message.ts1).pack(sender))
            elif kind == "TIMESYNC":
                received = time.monotonic_ns()
                rounds.append((received - message.ts1) / 1e6)
                offsets.append((message.tc1 - (received + message.ts1) / 2) / 1e6)
        if begun is None:
            continue
        if now >= beat:
            beat = now + 1.0
            line.write(sender.heartbeat_encode(2, 12, 0, 0, 3).pack(sender))
        if now >= sync:
            sync = now + 0.1
            line.write(sender.timesync_encode(0, time.monotonic_ns()).pack(sender))
        while sent < a.malformed * min(1.0, t / (0.8 * a.seconds)):
            line.write(damaged(draw, sender))
            sent += 1
    first = min(ages) if ages else None
    print(json.dumps(dict(
        counts=counts, lost=lost, bad=bad, nan=nan, resets=resets, texts=texts, heartbeats=heartbeats, malformed_sent=sent,
        px4=gates.px4, ardupilot=gates.ardupilot, states=states, ages=ages if a.ages else [],
        age_ms=dict(least=first, median=percentile(ages, 0.5), p99=percentile(ages, 0.99), most=max(ages, default=None)),
        timesync=dict(answers=len(rounds), round_ms=percentile(rounds, 0.5), offset_ms=percentile(offsets, 0.5)),
    )))
    if not line.socket:
        os.unlink(line.path)
        os.rmdir(os.path.dirname(line.path))


if __name__ == "__main__":
    main()
