"""An arm of one's own for rehearsals: what its user tells `init`, and touches that fit it."""

from importlib import resources
from pathlib import Path

from eds_variants import EdsVariant

from adacd_hil.wire.dbc_contract import contract_folder

OWN_ARM = """
extends = "certified"

[arm]
link_length_m = [0.4, 0.25]
rated_torque_Nm = [20.0, 8.0]
torque_limit_Nm = [18.0, 7.0]
position_limit_deg = [80.0, 110.0]
cad_theta = []

[devices]
drive_node = [11, 12]
sensor_node = [21, 22]
contract = ""
"""

OWN_SENSOR = """
kind = "sensor"
eds = "torque_sensor.eds"
[scale]
torque_Nm = 1e-6
[[pdo]]
message = "Torque"
number = 1
cob_id = 0x180
signals = [{ object = "0x9130:1", signal = "torque" }]
"""

OTHER_LAYOUT = """
[[pdo]]
message = "Feedback"
number = 3
cob_id = 0x380
signals = [{ object = "0x2069", signal = "velocity" }, { object = "0x2063", signal = "position" }]

[[pdo]]
message = "Status"
number = 4
cob_id = 0x480
transmission = 255
event_timer_ms = 50
signals = [{ object = "0x603F", signal = "error_code" }, { object = "0x6041", signal = "statusword" }]

[[pdo]]
message = "Command"
number = 2
cob_id = 0x300
signals = [
    { object = "0x2071", signal = "target_torque", unit = "permille" },
    { object = "0x6040", signal = "controlword" },
]
"""


def write_drive(folder: Path) -> Path:
    """Write a drive with position, velocity and target torque in objects of its maker, in other PDOs than ours.

    0x2000, the contract's in our devices, is its maker's own.
    """
    eds = EdsVariant().with_object("2000", 0, ObjectType="0x9")
    for index, kind, access in (
        ("2000sub1", "0x0007", "ro"),
        ("2000sub2", "0x0007", "ro"),
        ("2063", "0x0004", "ro"),
        ("2069", "0x0004", "ro"),
        ("2071", "0x0003", "rww"),
    ):
        eds.with_object(index, 0, DataType=kind, AccessType=access, PDOMapping="1")
    eds.write(folder / "other_drive.eds")
    ours = (resources.files("adacd_hil") / "device_profiles" / "stock-drive.toml").read_text()
    profile = folder / "other-drive.toml"
    profile.write_text(ours.partition("[[pdo]]")[0].replace("stock_drive.eds", "other_drive.eds") + OTHER_LAYOUT)
    return profile


def write_sensor_eds(folder: Path) -> Path:
    """Write the EDS of a torque sensor of 16 bits, whose mapping is fixed."""
    eds = (contract_folder() / "int32_sensor.eds").read_text()
    for old, new in (("0x91300120", "0x71300110"), ("9130", "7130"), ("32 bit", "16 bit"), ("int32", "int16")):
        eds = eds.replace(old, new)
    place = eds.index("[7130sub1]")
    path = folder / "int16_sensor.eds"
    path.write_text(eds[:place] + eds[place:].replace("DataType=0x0004", "DataType=0x0003"))
    return path


def eds_of_two_channels() -> str:
    """Give the EDS of a sensor with two torques in its frame, whose mapping is fixed."""
    eds = (contract_folder() / "int32_sensor.eds").read_text().rstrip() + "\n\n"
    for index, old, new in (("9130", "PV 1", "PV 2"), ("1A00", "0x91300120", "0x91300220")):
        begin = eds.index(f"[{index}sub1]")
        end = eds.index("\n\n", begin)
        row = eds[begin:end].replace("sub1", "sub2").replace(old, new)
        head = eds.index(f"[{index}]")
        counts = eds[head:begin].replace("SubNumber=2", "SubNumber=3").replace("DefaultValue=1", "DefaultValue=2")
        eds = f"{eds[:head]}{counts}{eds[begin:end]}\n\n{row}{eds[end:]}"
    return eds


def describe_arm(folder: Path) -> list[str]:
    """Write the devices' files; give the words after `init` that write the arm's, `my-arm.toml` in `folder`."""
    values: dict[str, tuple[object, object]] = {
        "--length-m": (0.4, 0.25),
        "--mass-kg": (2, 1),
        "--rated-torque-nm": (20, 8),
        "--torque-limit-nm": (18, 7),
        "--position-limit-deg": (80, 110),
        "--velocity-limit-deg-s": (220, 280),
        "--drive-node": (11, 12),
        "--sensor-node": (21, 22),
        "--drive": (drive := write_drive(folder), drive),
    }
    words = [str(folder / "my-arm.toml"), "--no-bus", "--flat", "--yes", "--eds", str(write_sensor_eds(folder))]
    for option, pair in values.items():
        words += [option, *map(str, pair)]
    return words


def describe_geared_arm(folder: Path) -> list[str]:
    """Give the words after `init` that write an arm whose motors count µNm behind gears, `my-arm.toml` in `folder`."""
    words = describe_arm(folder)
    place = words.index("--drive")
    return [*words[:place], *words[place + 3 :], "--drive", *["maxon-epos4"] * 2, "--gear", "50", "30"]


_ROW = "[[contacts]]\nat_s = {:.1f}\nlink = {}\npoint_m = {}\nangle_deg = {}\nforce_N = 20.0\nduration_s = 0.1\n"
_TOUCHES = ((1, 0.3, 90.0), (1, 0.3, -90.0), (2, 0.2, 90.0), (2, 0.2, -90.0))


def touches(count: int) -> str:
    """Write a scenario: once the model is certified, a touch every 1.3 s, each as short as a knock."""
    rows = "".join(_ROW.format(2.4 + 1.3 * number, *touch) for number, touch in enumerate(_TOUCHES[:count]))
    return f"lasts_s = {2.4 + 1.3 * count:.1f}\nstart_deg = [-30.0, -60.0]\n{rows}"


LINKS = [touch[0] for touch in _TOUCHES]
"""The link of each touch."""
