"""Typical mistakes of users: each gets one line with the remedy, the documented exit status, and no traceback.

A row: what is typed, the status, and words of the line, the remedy among them. Progress may precede the line.
"""

import shlex
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from foreign_arms import urdf_text

from adacd_hil.cli.main import main
from adacd_hil.log.log_files import LOG_NAME
from adacd_hil.wire.dbc_contract import contract_folder

FAILURE, USAGE, BUS_MISSING = 1, 2, 5

ARM = (contract_folder() / "arm.dbc").read_text()
FILES = {
    "my-arm.toml": "",
    "rad.toml": "[arm]\nposition_limit_deg = [0.9, 0.8]\n",
    "deg.toml": "[certified]\nstill_rad_s = 20.0\n",
    "grams.toml": "[certified]\npayload_std_kg = 3000\n",
    "one.toml": "[arm]\nlink_length_m = 0.35\n",
    "two.toml": "[bus]\narms = 2\n",
    "arm.urdf": urdf_text(3, ("0 0 1",) * 3, has_masses=False),
    "notes.txt": "hello",
    "log.mcap": "hello",
    "cut.mcap": "",
    "bad.dbc": "hello",
    "bus.log": "",
    "forty.dbc": 40 * ARM,
    "names.dbc": ARM.replace(" Drive2Emcy:", " Drive1Emcy:"),
    "identifiers.dbc": ARM.replace("BO_ 130 Drive2Emcy", "BO_ 129 Drive2Emcy"),
    "many.dbc": ARM
    + "".join(f'\nBO_ {1 << 31 | k} M{k}: 1 Host\n SG_ a : 0|8@1+ (1,0) [0|0] "" X\n' for k in range(1000)),
    "float.eds": (contract_folder() / "int32_sensor.eds").read_text().replace("9130", "6130"),
}
RUN = "run -i virtual -c x"
INIT = "init new.toml --no-bus --yes"
GONE = "link gone leads to unmounted, which is not there"

MISTAKES: tuple[tuple[str, int, tuple[str, ...]], ...] = (
    # -- the command line
    ("reprot runs", USAGE, ("No such command 'reprot'", "Did you mean 'report'?")),
    ("demo --profil P", USAGE, ("No such option '--profil'", "'--profile'")),
    ("demo --profile Q", USAGE, ("'Q' is not one of 'P', 'S', 'M'", "demo --help")),
    ("run -i socketcan", USAGE, ("Missing option '-c' / '--channel'", "run --help")),
    ("report", USAGE, ("Missing argument 'LOGS...'", "report --help")),
    ("report --from 5 --until 3 log.mcap", USAGE, ("--from 5 s is not before --until 3 s",)),
    ("monitor -i socketcan", USAGE, ("give --interface and --channel, or --url",)),
    ("demo --out ''", USAGE, ("Invalid value for '--out': the name is empty",)),
    ("report ''", USAGE, ("Invalid value for 'LOGS...': the name is empty",)),
    ("identify --init bus.log", USAGE, ("--init takes one recording and one URDF",)),
    ("identify bus.log", USAGE, ("--map is missing", "identify --init RECORDING URDF` writes one")),
    ("identify bus.log --map none.toml --from 5 --until 4", USAGE, ("--from 5 s is not before --until 4 s",)),
    ("sweep --out new", USAGE, ("a sweep is of LOGS or of --scenario",)),
    ("sweep --scenario paper --seeds 9:1 --out new", USAGE, ("--seeds '9:1'",)),
    ("sweep log.mcap --seeds 1:9 --out new", USAGE, ("--seeds has no effect with LOGS",)),
    ("sweep log.mcap --profile S --out new", USAGE, ("--profile has no effect with LOGS",)),
    ("sweep log.mcap --tls-key log.mcap --out new", USAGE, ("no effect without --scheduler",)),
    (
        "sweep log.mcap --workers 2 --scheduler tls://x:1 --out new",
        USAGE,
        ("--workers has no effect with --scheduler",),
    ),
    ("replay log.mcap --profile S", USAGE, ("--profile is for a recording without a log",)),
    ("replay bus.log --against log.mcap --dbc bad.dbc", USAGE, ("--dbc is for a recording without a log",)),
    ("log merge log.mcap log.mcap --out new.mcap", USAGE, ("mcap merge", "log cut")),
    ("log cut log.mcap --contact 1 --from 1 --out new.mcap", USAGE, ("--contact excludes --from and --until",)),
    ("log cut log.mcap --around 2 --out new.mcap", USAGE, ("--around has no effect without --contact",)),
    ("runs . --since yesterday", USAGE, ("'yesterday' is no date such as 2026-11-25",)),
    # -- the bus
    ("run -i sockecan -c can0", BUS_MISSING, ("unknown interface 'sockecan'", "did you mean 'socketcan'?")),
    ("run -i socketcan -c ''", USAGE, ("Invalid value for '-c' / '--channel': the name is empty", "run --help")),
    ("run -i socketcan -c cann0 --config demo", BUS_MISSING, ("CAN interface cann0 does not exist",)),
    ("scan -i socketcan -c cann0", BUS_MISSING, ("CAN interface cann0 does not exist", "did you mean 'can0'?")),
    ("run -i socketcan -c can0 --without-anchor", BUS_MISSING, ("CAN interface can0 is down", "ip link set can0 up")),
    ("run -i slcan -c tty1 --clock lockstep", USAGE, ("lockstep is for emulated arms", "it needs --clock realtime")),
    ("commtest -i virtual -c empty --seconds 0.1", BUS_MISSING, ("no boot-up from Drive1 (node 1)",)),
    ("tare -i virtual -c empty --poses 51", USAGE, ("`tare.poses` = 51 is above 50",)),
    ("tare -i virtual -c empty --out new.toml", BUS_MISSING, ("no boot-up from Drive1 (node 1)",)),
    ("run -i udp_multicast -c x --config certified", BUS_MISSING, ("echoes own frames", "use socketcan")),
    ("run -i slcan -c /dev/null --scenario paper", USAGE, ("plays the user of an emulated arm", "leave it out")),
    (f"{RUN} -b 1M", USAGE, ("'1M' is not a valid integer", "run --help")),
    ("init new.toml -i virtual -c x --yes", BUS_MISSING, ("drives that answer: none", "Check power, wiring and node")),
    ("monitor --url ws://127.0.0.1:1", FAILURE, ("nobody serves one there", "start the run with --live")),
    ("monitor --url ws://127.0.0.1:1 -i virtual -c x", USAGE, ("--url watches a run, --interface is of a bus",)),
    ("monitor --url ws://127.0.0.1:1 --config paper", USAGE, ("--url watches a run, --config is of a bus",)),
    ("monitor --url ws://127.0.0.1:1 --node 3", USAGE, ("--node has no effect with --url",)),
    ("monitor -i virtual -c x --seconds nan", USAGE, ("nan is not finite", "monitor --help")),
    ("excitation --seconds nan", USAGE, ("nan is not finite",)),
    ("thresholds log.mcap --rate-per-h nan", USAGE, ("nan is not finite",)),
    ("demo --live --live-port {port}", FAILURE, ("can't listen on 127.0.0.1:{port}", "--live-port 0 takes one")),
    ("demo --live --live-host a..b", FAILURE, ("can't listen on a..b:8765: that is no name of a machine",)),
    ("demo --live --live-host a..b --live-port 0", FAILURE, ("can't listen on a..b:0: that is no name",)),
    # -- the configuration
    ("demo --config papper", USAGE, ("'papper' is neither built in nor a file", "did you mean 'paper'?")),
    ("demo --config my-arms.toml", USAGE, ("my-arms.toml does not exist", "did you mean 'my-arm.toml'?")),
    ("demo --config another-name.toml", USAGE, ("does not exist", "`adacd-hil init` writes one")),
    ("demo --config utf16.toml", USAGE, ("byte 0 is not UTF-8", "save the file as UTF-8")),
    ("demo --config rad.toml", USAGE, ("0.9 deg is below 1 deg", "0.9 rad are 51.5662 deg")),
    ("demo --config deg.toml", USAGE, ("20.0 rad/s is above 1 rad/s", "20 deg/s are 0.349066 rad/s")),
    ("demo --config grams.toml", USAGE, ("3000.0 kg is above 1000 kg", "3000 g are 3 kg")),
    ("demo --config one.toml", USAGE, ("`arm.link_length_m` = 0.35 must be a list",)),
    ("demo --config two.toml --clock realtime", USAGE, ("`bus.arms` = 2: the arm of this process is alone on",)),
    ("demo --config ''", USAGE, ("configuration '' is neither built in nor a file; built in: ",)),
    ("sweep --scenario paper --vary detector.treshold_Nm=1 --out new", USAGE, ("did you mean `detector.threshold",)),
    ("config docs armm", USAGE, ("unknown group `armm`", "did you mean `arm`?")),
    # -- other inputs
    ("demo --scenario nowhere.toml", USAGE, ("nowhere.toml does not exist",)),
    ("demo --scenario papr", USAGE, ("scenario 'papr' is neither built in nor a file", "did you mean 'paper'?")),
    ("demo --scenario ''", USAGE, ("scenario '' is neither built in nor a file",)),
    ("sweep --scenario papr --out new", USAGE, ("did you mean 'paper'?",)),
    ("budget --dbc ''", USAGE, ("contract '' is neither built in nor a file; built in: ",)),
    (f"{RUN} --dbc none.dbc", USAGE, ("DBC none.dbc: No such file",)),
    (f"{RUN} --dbc bad.dbc", USAGE, ("DBC bad.dbc can't be read", "Invalid syntax at line 1")),
    ("budget --dbc forty.dbc", USAGE, ("DBC forty.dbc: ", "message Nmt is defined more than once")),
    ("budget --dbc names.dbc", USAGE, ("message Drive1Emcy is defined more than once",)),
    ("budget --dbc identifiers.dbc", USAGE, ("Drive1Emcy and Drive2Emcy have the same identifier",)),
    ("budget --dbc many.dbc", USAGE, ("1029 messages are more than 1000",)),
    ("budget --dbc arm_fdd", USAGE, ("contract 'arm_fdd' is neither built in nor a file", "did you mean 'arm_fd'?")),
    (f"budget --dbc {'a' * 300}", USAGE, ("is neither built in nor a file",)),
    (f"{INIT} --urdf arm.urdf", USAGE, ("3 joints move (joint1, joint2, joint3), an arm has 2 here", "with --lock")),
    (f"{INIT} --length-m 350 300", USAGE, ("350.0 m is above 5 m", "350 mm are 0.35 m")),
    ("init my-arm.toml --no-bus --yes", USAGE, ("my-arm.toml exists", "--force to replace it")),
    ("init new.toml", USAGE, ("stdin is not a terminal", "--channel or --no-bus")),
    ("init new.toml --no-bus", USAGE, ("or --yes for 0.35 0.3",)),
    (f"{INIT} --drive-node 3 4", USAGE, ("node ids 3, 4, 3, 4 of drives and sensors must differ",)),
    (f"{INIT} --mounting flor", USAGE, ("'flor' must be flat, floor",)),
    (f"{INIT} --mounting 100", USAGE, ("0 to 90 deg",)),
    (f"{INIT} --mounting floor --flat", USAGE, ("give one of them",)),
    (f"{INIT} --at-zero up", USAGE, ("--at-zero is of an arm that gravity reaches",)),
    (f"{INIT} --eds float.eds", USAGE, ("its 0x6130:1 is a float, which no frame of a cycle can hold",)),
    (f"{INIT} --gear 3 3", USAGE, ("profile adacd-drive of joint 1 has its own `scale.gear_ratio` = 1;",)),
    (
        f"{INIT} --drive nope nope",
        USAGE,
        ("built in: adacd-drive, adacd-drive-fd, adacd-drive-fd-500us, maxon-epos4, stock-drive, zeroerr-erob",),
    ),
    (f"{INIT} --drive maxon-epos4 stock-drive --gear 9 9", USAGE, ("profile stock-drive of joint 2 has its own",)),
    (f"{INIT} --sensor int32-sensor int32-sensor --torque-count-nm 1 1", USAGE, ("of joint 1 has its own",)),
    ("init new.toml --from . --length-m 1 1", USAGE, ("leave out --length-m",)),
    (f"{INIT} --torque-limit-nm 4 0", USAGE, ("`arm.torque_limit_Nm[1]` = 0 Nm: joint 2 can't move",)),
    # -- logs
    ("report folder", FAILURE, ("folder has no run.mcap, nor has any folder in it",)),
    ("report none.mcap", FAILURE, ("log none.mcap can't be read: No such file",)),
    ("report notes.txt", FAILURE, ("notes.txt is not an MCAP file",)),
    ("report cut.mcap", FAILURE, ("cut.mcap is empty",)),
    ("replay cut.mcap", FAILURE, ("cut.mcap is empty",)),
    ("thresholds cut.mcap", FAILURE, ("cut.mcap is empty",)),
    ("compare cut.mcap cut.mcap", FAILURE, ("cut.mcap is empty",)),
    ("replay none", FAILURE, ("log none can't be read: No such file",)),
    ("replay folder", FAILURE, ("folder has no run.mcap", "name a log, or the folder of a run")),
    ("runs none", FAILURE, ("none does not exist", "`adacd-hil demo` and `run` make")),
    ("runs folder", FAILURE, ("folder has no run",)),
    ("sweep none.mcap --out new", FAILURE, ("log none.mcap does not exist",)),
    ("play none.mcap -i socketcan -c none", FAILURE, ("none.mcap can't be read: No such file",)),
    ("replay bus.log", USAGE, ("--against the log of its run, or --config",)),
    ("log info cut.mcap", FAILURE, ("cut.mcap is empty",)),
    ("log info notes.txt", FAILURE, ("notes.txt is not an MCAP file",)),
    ("log info folder", FAILURE, ("folder folder has no .mcap file",)),
    ("history none.toml", USAGE, ("history none.toml does not exist", "`adacd-hil run --history` makes one")),
    # -- outputs
    ("demo --out notes.txt", USAGE, ("Directory 'notes.txt' is a file", "demo --help")),
    ("demo --out full", USAGE, (f"full/{LOG_NAME}",)),
    ("demo --out gone", USAGE, (GONE,)),
    ("demo --out gone/below", USAGE, (GONE,)),
    ("excitation --out gone/new.toml", USAGE, (GONE,)),
    ("log export x.mcap --format csv --out gone", USAGE, (GONE,)),
    (f"{RUN} --history gone/new.toml", USAGE, (GONE,)),
    (f"{RUN} --config paper --history new.toml", USAGE, ("--history: scheme 'paper' has no certificates",)),
    ("excitation --out notes.txt/new.toml", FAILURE, ("notes.txt/new.toml can't be written: notes.txt is no folder",)),
    ("tune none.mcap --out notes.txt/new.toml", FAILURE, ("can't be written: notes.txt is no folder",)),
    ("thresholds none.mcap --out notes.txt/new.toml", FAILURE, ("can't be written: notes.txt is no folder",)),
    ("excitation --config certified --out notes.txt", FAILURE, ("notes.txt can't be written: what is there is no",)),
    ("demo --out /sys/run", FAILURE, ("/sys/run: ", "give another place")),
    ("init /sys/new.toml --no-bus --yes", FAILURE, ("/sys/new.toml can't be written", "give another place")),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mistakes")
    for name, text in FILES.items():
        (path / name).write_text(text)
    (path / "utf16.toml").write_bytes("[arm]\n".encode("utf-16"))
    (path / "folder").mkdir()
    (path / "full").mkdir()
    (path / "full" / LOG_NAME).write_text("a log")
    (path / "gone").symlink_to("unmounted")
    return path


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    """A port that somebody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


@pytest.fixture
def interface(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One CAN interface in this machine, can0, which is down."""
    can0 = tmp_path / "net" / "can0"
    (can0 / "device").mkdir(parents=True)
    for name, text in (("type", "280"), ("flags", "0x0"), ("mtu", "16"), ("tx_queue_len", "10")):
        (can0 / name).write_text(text)
    monkeypatch.setattr("adacd_hil.wire.can_interface._INTERFACES", tmp_path / "net")
    monkeypatch.setattr("adacd_hil.wire.socketcan._require_socketcan", lambda channel: None)


@pytest.mark.parametrize(("typed", "status", "words"), MISTAKES, ids=[typed for typed, _, _ in MISTAKES])
def test_a_mistake_gets_one_line_with_the_remedy(folder, port, interface, monkeypatch, capsys, typed, status, words):
    monkeypatch.chdir(folder)
    before = sorted(folder.iterdir())
    with pytest.raises(SystemExit) as ended:
        main(shlex.split(typed.format(port=port)))
    told = capsys.readouterr()
    assert ended.value.code == status
    assert told.out == ""
    *progress, line = told.err.splitlines()
    assert line.startswith("adacd-hil: ")
    assert not any(text.startswith(("adacd-hil:", "Traceback", "Usage:")) for text in progress)
    for part in words:
        assert part.format(port=port) in line
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize("module", ["adacd_hil", "adacd_hil.cli.main"])
def test_python_m_is_the_command(module):
    ran = subprocess.run([sys.executable, "-m", module, "config", "shw"], capture_output=True, text=True, check=False)
    assert (ran.returncode, "did you mean 'show'?" in ran.stderr.lower()) == (USAGE, True)
