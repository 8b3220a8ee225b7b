"""The straightforward loop: the host's work as one would write it in an afternoon, for comparison.

    python tools/straightforward.py -c vcan0 --seconds 10

python-can's Bus for the frames, cantools for their content, the scheme in plain numpy, everything logged by mcap's
writer within the loop; SCHED_FIFO, no garbage collection, sleep to a grid. Nothing is left out that the host does in
every cycle, and nothing is made slower than it comes. The drives stay disabled: the arm is run at zero torque.

Prints one line of JSON; `--samples` gets the same columns as the yardstick's.
"""

import argparse
import gc
import json
import math
import os
import signal
import struct
import sys
import time
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
from cantools.autosar import end_to_end
from mcap.writer import CompressionType, Writer

from adacd_hil.device.arm import FEEDBACK_SHARE
from adacd_hil.scheme.detect.undone_filter import WIDE_SAMPLES
from adacd_hil.scheme.identify.excitation import EXCITATION_EVERY
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.wire.contract_frames import SYNC_OVERFLOW
from adacd_hil.wire.dbc_contract import contract_folder
from adacd_hil.wire.time_marks import ANSWERS

PRIORITY = 80
ADAPTATION_S = 5.2
DISABLED = {"e2e_crc": 0, "e2e_status": 0, "controlword": 0, "target_torque": 0}
SECOND_NS = 1_000_000_000
FRAME = struct.Struct("<4xIIIxI???B8s")
FRAME_TEXT = """std_msgs/Header header
uint32 id
bool is_rtr
bool is_extended
bool is_error
uint8 dlc
uint8[8] data
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec"""


class NumpyScheme:
    """The scheme's numbers in plain numpy: filters of eq. (16), regressor, least squares, termination, detector."""

    def __init__(self, settings: Settings) -> None:
        """Prepare from zero parameters, at rest."""
        count = len(settings.estimator.parameter_names)
        self.period_s = settings.bus.period_s
        self.a, self.b = settings.filter.a_rad_s, settings.filter.b_rad_s
        self.decay = math.exp(-self.a * self.period_s)
        self.weight_new = self.b / self.a * (1.0 - (1.0 - self.decay) / (self.a * self.period_s))
        self.weight_old = self.b / self.a * (1.0 - self.decay) - self.weight_new
        self.P = np.diag(settings.estimator.P0)
        self.R = 1.0 / self.period_s
        self.to_Nm = -self.a / self.b
        self.to_wide = 1.0 / ((1.0 - self.decay) * WIDE_SAMPLES)
        self.cad_theta = settings.cad_theta if settings.arm.cad_theta else np.zeros(count)
        self.beta_Nm = settings.termination.beta_Nm
        inertia, viscous, coulomb, _ = settings.termination.excitation_scale
        self.scale = np.outer(*2 * ([inertia] * 3 + [viscous] * 2 + [coulomb] * 2,))
        self.threshold_Nm = np.array(settings.detector.threshold_Nm)
        self.standstill_rad_s = settings.detector.standstill_rad_s
        self.theta_hat = np.zeros(count)
        self.Y_p, self.Y_h = np.zeros((2, count)), np.zeros((2, count))
        self.input_old, self.S, self.W_f = np.zeros((2, count)), np.zeros((2, count)), np.zeros((2, count))
        self.tau_old, self.tau_f = np.zeros(2), np.zeros(2)
        self.tau_ext_hat, self.tau_ext_hat_cad, self.tau_ext_wide_hat = np.zeros(2), np.zeros(2), np.zeros(2)
        self.history = np.zeros((WIDE_SAMPLES + 1, 2))
        self.standstill, self.threshold = np.zeros(2), np.full(2, np.inf)
        self.low, self.high = np.full(4, np.inf), np.full(4, -np.inf)
        self.information = np.zeros((count, count))
        self.excitation = 0.0
        self.samples = self.quiet_cycles = 0

    def step(self, q: Any, dq: Any, tau_J: Any, is_learning: bool) -> bool:
        """Take in one sample, float64 (2,) each; return whether a joint is over its threshold."""
        q2, (dq1, dq2) = float(q[1]), dq.tolist()
        cosine = math.cos(q2)
        Y_p, Y_h = self.Y_p, self.Y_h
        Y_p[0, 0], Y_p[0, 1], Y_p[0, 2] = dq1, cosine * (2.0 * dq1 + dq2), dq2
        Y_p[1, 1], Y_p[1, 2] = cosine * dq1, dq1 + dq2
        Y_h[1, 1] = math.sin(q2) * dq1 * (dq1 + dq2)
        Y_h[0, 3], Y_h[1, 4] = dq1, dq2
        Y_h[0, 5], Y_h[1, 6] = (dq1 > 0.0) - (dq1 < 0.0), (dq2 > 0.0) - (dq2 < 0.0)
        input_new = Y_h - self.a * Y_p
        if self.samples == 0:
            self.S = -self.b * Y_p
        else:
            self.tau_f = self.decay * self.tau_f + self.weight_old * self.tau_old + self.weight_new * tau_J
            self.S = self.decay * self.S + self.weight_old * self.input_old + self.weight_new * input_new
        self.W_f = W_f = self.b * Y_p + self.S
        self.input_old, self.tau_old = input_new, tau_J
        residual = self.tau_f - W_f @ self.theta_hat
        self.tau_ext_hat = residual * self.to_Nm
        self.tau_ext_hat_cad = (self.tau_f - W_f @ self.cad_theta) * self.to_Nm
        history = self.history
        history[1:] = history[:-1]
        history[0] = self.tau_ext_hat
        total = history.sum(axis=0)
        self.tau_ext_wide_hat = (total - history[-1] - self.decay * (total - history[0])) * self.to_wide
        is_still = np.abs(dq) < self.standstill_rad_s
        self.standstill = is_still + self.decay * (self.standstill - is_still)
        self.samples += 1
        tau1, tau2 = self.tau_ext_hat.tolist()
        if is_learning:
            is_quiet = abs(tau1) <= self.beta_Nm and abs(tau2) <= self.beta_Nm
            self.quiet_cycles = self.quiet_cycles + 1 if is_quiet else 0
            self._learn(q, dq, residual)
            return False
        self.threshold = self.threshold_Nm + self.standstill * np.maximum(self.theta_hat[5:7], 0.0)
        limit1, limit2 = self.threshold.tolist()
        return abs(tau1) > limit1 or abs(tau2) > limit2

    def _learn(self, q: Any, dq: Any, residual: Any) -> None:
        """Gather the evidence for eq. (15), then correct the parameters by eq. (10)."""
        W_f = self.W_f
        motion = np.concatenate((q, dq))
        np.minimum(self.low, motion, out=self.low)
        np.maximum(self.high, motion, out=self.high)
        self.information += self.period_s * (W_f.T @ W_f)
        if self.samples % EXCITATION_EVERY == 0:
            self.excitation = float(np.linalg.eigvalsh(self.scale * self.information)[0])
        PW = self.P @ W_f.T
        (g11, g12), (_, g22) = (W_f @ PW).tolist()
        g11, g22 = g11 + self.R, g22 + self.R
        inverse = np.array([[g22, -g12], [-g12, g11]]) / (g11 * g22 - g12 * g12)
        K = PW @ inverse
        self.theta_hat = self.theta_hat + K @ residual
        self.P = self.P - K @ PW.T


class InlineLog:
    """An MCAP file that is written within the loop: frames, decoded values, the state of every cycle."""

    def __init__(self, path: Path, database: Any) -> None:
        """Open it. Raises OSError."""
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=256 * 1024, compression=CompressionType.ZSTD)
        self._writer.start()
        schema = self._writer.register_schema("can_msgs/msg/Frame", "ros2msg", FRAME_TEXT.encode())
        self._raw = {
            is_sent: self._writer.register_channel(topic, "cdr", schema)
            for is_sent, topic in ((True, "/to_can_bus"), (False, "/from_can_bus"))
        }
        self._decoded = {}
        for message in database.messages:
            text = "\n".join(f"float64 {signal.name.lower()}" for signal in message.signals)
            schema = self._writer.register_schema(f"arm_msgs/msg/{message.name}", "ros2msg", text.encode())
            channel = self._writer.register_channel(f"/decoded/{message.name}", "cdr", schema)
            self._decoded[message.name] = channel, struct.Struct(f"<4x{len(message.signals)}d")
        self._cycle = self._register_cycle()

    def _register_cycle(self) -> int:
        text = (
            "int64 cycle\nint64 lateness_ns\nint64 feedback_ns\nint64 command_ns\nfloat64[2] q\nfloat64[2] dq\n"
            "float64[2] tau_j\nfloat64[2] tau_f\nfloat64[2] tau_ext_hat\nfloat64[2] tau_ext_hat_cad\n"
            "float64[2] tau_ext_wide_hat\nfloat64[7] theta_hat\nfloat64[2] threshold\nfloat64[2] tau_d"
        )
        schema = self._writer.register_schema("arm_msgs/msg/Cycle", "ros2msg", text.encode())
        return self._writer.register_channel("/cycle", "cdr", schema)

    def frame(self, is_sent: bool, can_id: int, data: bytes, t_ns: int) -> None:
        """Log a raw frame."""
        seconds, rest = divmod(t_ns, SECOND_NS)
        packed = FRAME.pack(seconds, rest, 1, can_id, False, False, False, len(data), data)
        self._writer.add_message(self._raw[is_sent], t_ns, packed, t_ns)

    def decoded(self, name: str, values: dict[str, Any], t_ns: int) -> None:
        """Log what cantools made of a frame."""
        channel, layout = self._decoded[name]
        self._writer.add_message(channel, t_ns, layout.pack(*values.values()), t_ns)

    def cycle(self, numbers: tuple[int, int, int, int], values: list[Any], t_ns: int) -> None:
        """Log how the cycle went, and the scheme's state."""
        packed = b"\x00\x01\x00\x00" + struct.pack("<4q", *numbers) + np.concatenate(values).tobytes()
        self._writer.add_message(self._cycle, t_ns, packed, t_ns)

    def close(self) -> None:
        """Finish the file."""
        self._writer.finish()
        self._file.close()


class Loop:
    """The loop, on one bus."""

    def __init__(self, channel: str, settings: Settings, log: Path) -> None:
        """Open bus and log. Raises CanError, OSError."""
        self.settings = settings
        self.period_ns = settings.bus.period_ns
        self.database = database = cantools.database.load_file(contract_folder() / "arm.dbc")
        self.feedback_ids = [database.get_message_by_name(name).frame_id for name in ANSWERS]
        sensors = ("Sensor1Torque", "Sensor2Torque")
        self.data_ids = {name: self._data_ids(name) for name in (*sensors, "Drive1Command", "Drive2Command")}
        filters = [
            {"can_id": message.frame_id, "can_mask": 0x7FF}
            for message in database.messages
            if "HOST" in message.receivers
        ]
        self.bus = can.Bus(channel, interface="socketcan", can_filters=filters)
        self.log = InlineLog(log, database)
        self.scheme = NumpyScheme(settings)
        self.Kp, self.Kd = np.array(settings.controller.Kp), np.array(settings.controller.Kd)
        self.limit = np.array(settings.arm.torque_limit_Nm)
        self.q, self.dq, self.tau_J, self.q_d = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
        self.wall_ns = 0
        self.samples: list[tuple[int, ...]] = []
        self.overruns = self.incomplete = self.rejected = self.counter = 0
        self.is_stopped = False

    def _data_ids(self, name: str) -> list[int]:
        return list(bytes.fromhex(self.database.get_message_by_name(name).dbc.attributes["E2EDataIdList"].value))

    def stop(self, *_: object) -> None:
        """End after this cycle."""
        self.is_stopped = True

    def send(self, name: str, values: dict[str, Any]) -> None:
        """Encode, protect, send and log a frame."""
        message = self.database.get_message_by_name(name)
        data: bytes | bytearray | None = message.encode(values)
        if name in self.data_ids:
            data = end_to_end.apply_profile2_crc(bytes(data or b""), self.data_ids[name][self.counter])
        sent = can.Message(arbitration_id=message.frame_id, data=data, is_extended_id=False)
        self.bus.send(sent)
        t_ns = time.time_ns()
        self.log.frame(True, message.frame_id, bytes(sent.data), t_ns)
        self.log.decoded(name, values, t_ns)

    def start(self) -> None:
        """Reset the nodes and put them into operation."""
        for command in (0x82, 0x01):
            self.send("Nmt", {"command": command, "node": 0})
            time.sleep(0.3)  # as one writes it in an afternoon: long enough for any device to boot

    def receive(self, values: dict[str, dict[str, Any]]) -> float | None:
        """Receive, check, decode and log until all four answers are in; return the kernel's stamp of the last, s."""
        stamp_s = None
        while not all(name in values for name in ANSWERS):
            frame = self.bus.recv(FEEDBACK_SHARE * self.period_ns * 1e-9)
            if frame is None:
                self.incomplete += 1
                break
            stamp_s = frame.timestamp
            message = self.database.get_message_by_frame_id(frame.arbitration_id)
            t_ns = round(stamp_s * 1e9)
            self.log.frame(False, frame.arbitration_id, bytes(frame.data), t_ns)
            decoded = message.decode(bytes(frame.data), decode_choices=False)
            self.log.decoded(message.name, decoded, t_ns)
            if message.name in self.data_ids:
                data_id = self.data_ids[message.name][decoded["e2e_counter"]]
                if not end_to_end.check_profile2_crc(bytes(frame.data), data_id):
                    self.rejected += 1
                    continue
            values[message.name] = decoded
        return stamp_s

    def run(self, seconds: float) -> dict[str, Any]:
        """Run cycles; return how it went."""
        period_ns = self.period_ns
        self.start()
        self.wall_ns = time.time_ns() - time.monotonic_ns()
        start_ns = -(-time.monotonic_ns() // period_ns) * period_ns
        end_ns = start_ns + int(seconds * 1e9)
        heartbeat_cycles = max(1, round(self.settings.bus.heartbeat_ms * 1e6 / period_ns))
        cycle, done = -1, 0
        print("running", file=sys.stderr, flush=True)
        busy_ns = time.process_time_ns()
        while not self.is_stopped:
            cycle += 1
            due_ns = start_ns + cycle * period_ns
            left_ns = due_ns - time.monotonic_ns()
            if left_ns > 0:
                time.sleep(left_ns * 1e-9)
            now_ns = time.monotonic_ns()
            skipped = (now_ns - due_ns) // period_ns
            if skipped > 0:
                self.overruns += skipped
                cycle += skipped
                due_ns += skipped * period_ns
            if due_ns >= end_ns:
                break
            self.turn(cycle, done, due_ns, now_ns)
            if cycle % heartbeat_cycles == 0:
                self.send("HostHeartbeat", {"state": 5})
            done += 1
        busy_ns = time.process_time_ns() - busy_ns
        self.send("Nmt", {"command": 0x80, "node": 0})
        return {"cycles": done, "cpu_us": busy_ns * 1e-3 / max(done, 1)}

    def turn(self, cycle: int, done: int, due_ns: int, now_ns: int) -> None:
        """Go once through the loop: SYNC, answers, scheme, controller, commands, log."""
        scheme = self.scheme
        self.send("Sync", {"counter": done % SYNC_OVERFLOW + 1})
        values: dict[str, dict[str, Any]] = {}
        stamp_s = self.receive(values)
        in_ns = time.monotonic_ns()
        if len(values) == len(ANSWERS):
            drives = values["Drive1Feedback"], values["Drive2Feedback"]
            self.q = np.array([drive["position"] for drive in drives])
            self.dq = np.array([drive["velocity"] for drive in drives])
            self.tau_J = np.array([values["Sensor1Torque"]["torque"], values["Sensor2Torque"]["torque"]])
            scheme.step(self.q, self.dq, self.tau_J, is_learning=done * self.period_ns < ADAPTATION_S * 1e9)
            self.q_d = self.q if done == 0 else self.q_d
        tau_d = np.minimum(np.maximum(self.Kp * (self.q_d - self.q) - self.Kd * self.dq, -self.limit), self.limit)
        self.counter = (self.counter + 1) % 16
        for name in ("Drive1Command", "Drive2Command"):
            self.send(name, DISABLED | {"e2e_counter": self.counter})
        out_ns = time.monotonic_ns()
        fields = [self.q, self.dq, self.tau_J, scheme.tau_f, scheme.tau_ext_hat, scheme.tau_ext_hat_cad]
        fields += [scheme.tau_ext_wide_hat, scheme.theta_hat, scheme.threshold, tau_d]
        times = now_ns - due_ns, in_ns - now_ns, out_ns - now_ns
        self.log.cycle((cycle, *times), fields, now_ns + self.wall_ns)
        answer_ns = 0 if stamp_s is None else out_ns + self.wall_ns - round(stamp_s * 1e9)
        self.samples.append((due_ns, *times[:2], out_ns - in_ns, times[2], answer_ns))

    def close(self) -> None:
        """Close bus and log."""
        self.bus.shutdown()
        self.log.close()


def main() -> int:
    """Run on a bus."""
    parser = argparse.ArgumentParser(description="A straightforward 1 kHz loop with python-can, cantools and mcap.")
    parser.add_argument("-c", "--channel", default="vcan0", help="CAN interface")
    parser.add_argument("--seconds", type=float, default=3600.0, help="ends after this time, or by SIGINT")
    parser.add_argument("--log", type=Path, required=True, help="MCAP file")
    parser.add_argument("--samples", type=Path, help="file for the times of the cycles, as the yardstick's")
    chosen = parser.parse_args()
    loop = Loop(chosen.channel, load_settings("paper", "P"), chosen.log)
    scheduler = "SCHED_OTHER"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        scheduler = f"SCHED_FIFO {PRIORITY}"
    except OSError:
        pass
    signal.signal(signal.SIGINT, loop.stop)
    signal.signal(signal.SIGTERM, loop.stop)
    gc.collect()
    gc.disable()
    try:
        described = loop.run(chosen.seconds)
    finally:
        loop.close()
    if chosen.samples is not None:
        chosen.samples.write_bytes(np.array(loop.samples, np.int64).tobytes())
    described |= {"name": "straightforward", "scheduler": scheduler, "period_us": loop.period_ns // 1000}
    described |= {"overruns": loop.overruns, "cycles_incomplete": loop.incomplete, "frames_rejected": loop.rejected}
    print(json.dumps(described))
    return 0


if __name__ == "__main__":
    sys.exit(main())
