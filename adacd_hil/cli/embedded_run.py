"""A scenario in one process: host and emulated arm on the embedded bus."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from adacd_hil.cli.connection import make_clock, model_time
from adacd_hil.clock import LOCKSTEP, wall_offset_ns
from adacd_hil.control.cycle_compilation import compiling_cycle
from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.control.session import LiveView, Session, SessionSummary
from adacd_hil.device.contract import load_contract
from adacd_hil.device.device_files import place_devices
from adacd_hil.log.log_files import CONFIG_DIGEST_KEY, EMBEDDED, TRUTH_NAME
from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.log.viewer_layout import viewer_files
from adacd_hil.records import Vector
from adacd_hil.scheme.pipeline.new_pipeline import new_pipeline
from adacd_hil.score.emulator_truth import config_digest
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import configuration_layers, load_settings, resolved_table
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.run_settings import RequestSettings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_text import to_toml
from adacd_hil.terminal import on_interrupt
from adacd_hil.wire.budget import describe_excess
from adacd_hil.wire.embedded_bus import EmbeddedBus
from firmware_sim.bench.bench import Bench
from firmware_sim.bench.bench_time import TruthLog
from firmware_sim.canopen.object_dictionary import EmulatedContract, playable_contract
from firmware_sim.cli.own_devices import rehearse_settings
from firmware_sim.scenario.rehearsal import told_arm
from firmware_sim.scenario.scenario import Scenario, load_scenario, named_profile

SCENARIO = "paper"
"""The scenario whose user's requests are in the host's script; users of other scenarios only ask to finish."""
USER = "demo"
"""The configuration with that script, used for configurations without one."""


_TOUCHED_LINK = TRUTH_LAYOUT.slices["contact_link"].start


class Cast(NamedTuple):
    """Host and emulated arm of a run, resolved.

    contract: the emulator's, if it plays an arm of one's own; None: it plays the host's contract. assumed: a line
    for each assumption about such an arm, for the user.
    """

    settings: Settings
    scenario: Scenario
    contract: EmulatedContract | None = None
    assumed: tuple[str, ...] = ()


def resolve(config: str, scenario_name: str, profile: str | None, seed: int | None, truth: str | None = None) -> Cast:
    """Return host settings and emulated arm of a run, by configuration and scenario.

    The emulator plays the configured arm if there is a truth, or if the configuration describes an arm of one's own
    and no profile is given. Otherwise it plays a built-in arm, and the host has its profile: the given one, else the
    scenario's, else the configuration's. truth: name or file of the emulated arm's true values. seed: None: the
    scenario's. A configuration without a script gets the demo's, and its acknowledgement of stops unless it has one; in
    a scenario other than SCENARIO the script only asks to finish at its end, and faults are acknowledged as the
    scenario sets it. A built-in arm gets its motors' holding torque from its data sheet, unless the configuration has
    one; the configured arm keeps the value of its file. Raises ConfigError or CodecError if configuration, scenario or
    contract can't be used.
    """
    contract: EmulatedContract | None = None
    assumed: list[str] = []
    layers = configuration_layers(config, profile)
    settings = parse(Settings, resolved_table(layers))
    if truth is not None or (profile is None and told_arm(settings, layers).is_own):
        _, contract, scenario, assumed = rehearse_settings(settings, layers, scenario_name, truth, seed)
    else:
        settings = load_settings(config, profile or named_profile(scenario_name))
        scenario = load_scenario(scenario_name, settings.arm.profile, seed)
    operator = settings.operator
    if not operator.script:  # an emulated arm needs a scripted user
        user = load_settings(USER).operator
        operator = dataclasses.replace(
            operator,
            script=user.script,
            acknowledge_after_s=operator.acknowledge_after_s or user.acknowledge_after_s,
        )
    if scenario_name != SCENARIO:
        operator = dataclasses.replace(
            operator,
            script=(RequestSettings(at_s=scenario.lasts_s, request="finish"),),
            acknowledge_faults=scenario.acknowledge_faults,
        )
    arm = settings.arm
    if contract is None and arm.holding_torque_Nm is None:
        arm = dataclasses.replace(arm, holding_torque_Nm=scenario.mechanics.holding_torque_Nm)
    return Cast(dataclasses.replace(settings, arm=arm, operator=operator), scenario, contract, tuple(assumed))


def run_embedded(
    cast: Cast,
    clock_name: str,
    out: Path,
    progress: Callable[[str], None] = lambda _: None,
    live: LiveView | None = None,
    on_started: Callable[[], None] = lambda: None,
) -> tuple[SessionSummary, Path]:
    """Run host and emulated arm in this process, with both logs in `out`; return the summary and the path of the truth.

    clock_name: `lockstep` or `realtime`. progress: takes lines about the run. live: serves the host's log to viewers;
    None: not served. on_started: called when the devices become Operational for the first time. Raises ConfigError,
    CodecError or LogError for invalid settings, such as those of several arms, or logs, OSError if a file can't be
    written. After an error the truth's log is discarded.
    """
    settings, scenario = cast.settings, cast.scenario
    if settings.bus.is_shared:
        raise ConfigError(f"`bus.arms` = {settings.bus.arms}: the arm of this process is alone on its bus, 1 expected")
    devices = place_devices(settings)
    codec = load_contract(settings, devices)
    if excess := describe_excess(codec, settings):
        progress(f"the bus is too slow for this arm: {excess}")
    contract = cast.contract or playable_contract(codec)
    clock = make_clock(clock_name)
    embedded = EmbeddedBus(clock)
    bus = model_time(embedded, clock, codec, settings)
    out.mkdir(parents=True, exist_ok=True)
    host = {CONFIG_DIGEST_KEY: config_digest(to_toml(settings))}
    is_lockstep = clock_name == LOCKSTEP
    with TruthLog(
        out / TRUTH_NAME,
        blocking=is_lockstep,
        metadata=host,
        scenario=scenario,
        epoch_ns=0 if is_lockstep else wall_offset_ns(),
    ) as truth:
        try:
            touched_ns: int | None = None  # since when somebody touches the arm, for the progress lines alone

            def write_truth(cycle: int, t_ns: int, block: Vector) -> None:
                nonlocal touched_ns
                touched_ns = None if block[_TOUCHED_LINK] == 0.0 else touched_ns or t_ns
                truth.write(cycle, t_ns, block)

            with compiling_cycle(settings):
                bench = Bench(
                    scenario,
                    codec,
                    embedded.deliver,
                    contract=contract,
                    on_truth=write_truth,
                    on_event=truth.event,
                )
                new_pipeline(settings).compile_cycle()
            embedded.attach(bench.on_frame)
            bench.boot()
            session = Session(
                settings,
                codec,
                devices,
                bus,
                clock,
                ScriptedOperator(settings.operator),
                out,
                EMBEDDED,
                metadata={
                    "scenario": scenario.name,
                    "seed": str(scenario.seed),
                    **({"truth": scenario.truth} if scenario.truth else {}),
                },
                progress=progress,
                viewer_files=viewer_files(settings),
                live=live,
                on_started=on_started,
                touched_ns=lambda: touched_ns,
            )
            with on_interrupt(session.interrupt):
                summary = session.run()
            bench.outlive_host()  # the truth ends with an arm at rest, even after an error
        except BaseException:
            truth.discard()
            raise
    return summary, truth.path
