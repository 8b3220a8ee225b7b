"""The paper's experiment in one process: host and emulated arm on the embedded bus, then the report."""

from pathlib import Path

from adacd_hil.analysis.report import Report, write_report
from adacd_hil.cli.connection import check_shared, contract_of, make_clock, model_time, on_interrupt
from adacd_hil.cli.exit_codes import CommandError, ExitCode, exit_code
from adacd_hil.cli.progress import Progress
from adacd_hil.cli.report import TRUTH_NAME
from adacd_hil.clock import VirtualClock
from adacd_hil.config import load_settings
from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.control.session import Session
from adacd_hil.wire.bus import Bus, EmbeddedBus
from firmware_sim.bench import Bench
from firmware_sim.scenario import load_scenario
from firmware_sim.truth import TruthLog

SCENARIO = "paper"


def play(config: str, profile: str | None, seed: int | None, clock_name: str, out: Path) -> tuple[Report, ExitCode]:
    """Play the experiment and report it. Raises ConfigError, CodecError, LogError, CommandError."""
    settings = load_settings(config, profile)
    check_shared("lockstep", settings)  # an arm in this process has no neighbour
    scenario = load_scenario(SCENARIO, settings.arm.profile, seed)
    codec = contract_of(settings, out)
    clock = make_clock(clock_name)
    embedded = EmbeddedBus(clock)
    bus: Bus = model_time(embedded, clock, codec, settings) if isinstance(clock, VirtualClock) else embedded
    out.mkdir(parents=True, exist_ok=True)
    progress = Progress()
    progress(f"experiment of configuration {settings.name}, profile {settings.arm.profile}, in {out}")
    with TruthLog(out / TRUTH_NAME, blocking=clock_name == "lockstep", scenario=scenario) as truth:
        bench = Bench(scenario, codec, embedded.deliver, on_truth=truth.write, on_event=truth.event)
        embedded.attach(bench.on_frame)
        bench.boot()
        session = Session(
            settings,
            codec,
            bus,
            clock,
            ScriptedOperator(settings.operator),
            out,
            "embedded",
            metadata={"scenario": SCENARIO, "seed": str(scenario.seed)},
            progress=progress,
        )
        with on_interrupt(session.interrupt):
            summary = session.run()
    if summary.result is not None:
        played_s = summary.result.cycles * settings.bus.period_s
        pace = played_s / summary.elapsed_s
        progress(f"{played_s:.1f} s played in {summary.elapsed_s:.1f} s: {pace:.1f} x real time")
    progress("drawing the report")
    report = write_report(summary.log.path, truth.path, out)
    progress(f"report: {out / 'report.html'}")
    progress.close()
    if summary.error:
        raise CommandError(summary.error, exit_code(summary))
    return report, exit_code(summary)
