"""The C yardstick: builds it and writes its arguments, so that it needs to know no protocol."""

import shutil
import subprocess
from pathlib import Path

from adacd_hil.settings.arm_settings import BusSettings
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.time_marks import ANSWERS

SOURCE = Path(__file__).resolve().parent / "yardstick.c"
FLAGS = ("-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror")
COLUMNS = ("due", "lateness", "feedback", "compute", "command", "answer")
"""Of a sample in the file of option -o; int64, ns."""
COMMANDS = ("Drive1Command", "Drive2Command")
RESET_COMMUNICATION, START, PRE_OPERATIONAL = 0x82, 0x01, 0x80
OPERATIONAL = 5


def build(folder: Path, source: Path = SOURCE, *options: str) -> tuple[Path | None, str]:
    """Compile a program into a folder; without a C compiler return None and one line that says so.

    Raises CalledProcessError when it doesn't compile.
    """
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        return None, f"no C compiler (cc, gcc, clang), so no {source.stem}; on Debian: apt-get install gcc libc6-dev"
    program = folder / source.stem
    subprocess.run([compiler, *FLAGS, *options, "-o", program, source], check=True)
    return program, ""


def command_frames(codec: Codec, name: str) -> list[bytes]:
    """List the frames of one command in the order of their counter: disabled drive, no torque, end-to-end header."""
    message = codec.message(name)
    sender = message.sender()
    body = [0] * len(message.values)  # controlword 0 is Disable voltage
    return [bytes(sender.protect(message.encode_raw(*body))) for _ in range(max(1, message.receiver().counter_range))]


def arguments(codec: Codec, channel: str, period_us: int, seconds: float, warm_up_s: float, samples: Path) -> list[str]:
    """Write the command line for a contract: nodes reset and started, commands that leave the drives disabled."""
    answers = [codec.message(name).can_id for name in ANSWERS]
    others = [message.can_id for message in codec.messages.values() if message.can_id not in answers]
    nmt = codec.message("Nmt").can_id
    heartbeat = codec.message("HostHeartbeat").can_id
    every = max(1, round(BusSettings().heartbeat_ms * 1e3 / period_us))
    written = ["-i", channel, "-p", str(period_us), "-d", f"{seconds:g}", "-w", f"{warm_up_s:g}", "-o", str(samples)]
    written += ["-s", f"{codec.message('Sync').can_id:03X}"]
    for can_id in answers:
        written += ["-r", f"{can_id:03X}"]
    for can_id in others:
        written += ["-x", f"{can_id:03X}"]
    for name in COMMANDS:
        data = ",".join(frame.hex().upper() for frame in command_frames(codec, name))
        written += ["-c", f"{codec.message(name).can_id:03X}#{data}"]
    for order in (RESET_COMMUNICATION, START):
        written += ["-n", f"{nmt:03X}#{order:02X}00"]
    return [*written, "-z", f"{nmt:03X}#{PRE_OPERATIONAL:02X}00", "-e", f"{every}:{heartbeat:03X}#{OPERATIONAL:02X}"]
