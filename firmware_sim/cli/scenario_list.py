"""The command line's output about scenarios: their list, and the errors of a file."""

from dataclasses import dataclass
from typing import Any

from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.wire.codec import Codec
from firmware_sim.bench.fault_plan import FaultPlan
from firmware_sim.bench.fault_rows import check_objects
from firmware_sim.canopen.object_dictionary import ObjectDictionary, contract_of
from firmware_sim.scenario.faults import NODES
from firmware_sim.scenario.scenario import Scenario, builtin_scenarios, load_scenario, read_table


@dataclass(frozen=True)
class ScenarioFinding:
    """The result of checking one scenario file.

    `problems`: one line each, () if there are none; `checked`: then, a summary of the checked content.
    """

    file: str
    problems: tuple[str, ...]
    checked: str = ""

    @property
    def lines(self) -> list[str]:
        """Lines for a terminal, each with the file's name: the problems, or one line "good" with `checked`."""
        return [f"{self.file}: {problem}" for problem in self.problems] or [f"{self.file}: good: {self.checked}"]


def describe_all() -> list[dict[str, Any]]:
    """Return a table per built-in scenario: name, group, about, lasts_s, expect.

    They are sorted by group and name; `expect` is "" without an expectation.
    """
    scenarios = sorted((load_scenario(name) for name in builtin_scenarios()), key=lambda one: (one.group, one.name))
    return [
        {
            "name": one.name,
            "group": one.group,
            "about": one.about,
            "lasts_s": one.lasts_s,
            "expect": "" if one.expect is None else one.expect.text,
        }
        for one in scenarios
    ]


def check(file: str, codec: Codec) -> ScenarioFinding:
    """Check a scenario file, and its faults' frames and objects against a contract.

    Return its problems, or a summary if it has none. A file that can't be read is a problem, too. Objects whose values
    faults replace are looked up in the EDS files of the contract that `contract_of` finds.
    """
    try:
        table = read_table(file)
    except ConfigError as error:
        return ScenarioFinding(file, (str(error).removeprefix(f"scenario {file}").removeprefix(":").strip(),))
    try:
        scenario = parse(Scenario, table)
        FaultPlan(scenario.faults, scenario.seed, codec)
        contract = contract_of(codec)
        places = [contract.describe_device(place) for place in range(len(NODES))]
        check_objects(scenario.faults, [ObjectDictionary(1, device, lambda *_: None) for device in places])
    except ConfigError as error:
        return ScenarioFinding(file, error.problems)
    return ScenarioFinding(file, (), _checked(scenario, codec))


_TIMED = ("payloads", "contacts", "bodies", "hands", "walls", "faults")


def _checked(scenario: Scenario, codec: Codec) -> str:
    counts = [f"{len(rows)} of [[{key}]]" for key in _TIMED if (rows := getattr(scenario, key))]
    late = [
        f"`{key}[{index}]` at {row.at_s:g} s"
        for key in _TIMED
        for index, row in enumerate(getattr(scenario, key))
        if not getattr(row, "is_from_power_on", False) and row.at_s >= scenario.lasts_s
    ]
    parts = ["keys, types and bounds", *counts, f"all of it against arm {scenario.profile}"]
    if scenario.faults:
        parts.append(f"frames and objects of faults against contract {codec.path.stem}")
    if late:
        parts.append(f"`demo` ends before {', '.join(late)}: lasts_s = {scenario.lasts_s:g} s")
    if scenario.expect is not None:
        parts.append(f"expects {scenario.expect.text}")
    return "; ".join(parts)
