"""The service that carries frames and time between a bench and a bus."""

from adacd_hil.clock import Clock
from adacd_hil.records import JOINTS
from adacd_hil.wire.bus import Bus, BusError, Frame, InterfaceDownError
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.open_bus import open_bus
from adacd_hil.wire.time_marks import HOST_MARK, NEVER_NS
from firmware_sim.bench.bench import Bench, ClockMode
from firmware_sim.bench.bench_time import LONGEST_ORPHANAGE_NS
from firmware_sim.bench.injector import Departure
from firmware_sim.canopen.pdo_record import LISTENED_IDS

_IDLE_NS = 10_000_000  # without SYNC for this long, timers go by the clock: heartbeats before and between runs
_LONGEST_WAIT_NS = 50_000_000  # how soon a signal is noticed on a silent bus
SILENCE_NS = 2_000_000_000  # a host that is silent for this long has gone


class StopRequest:
    """A request to end the emulator. `is_made` gets True by `make`."""

    def __init__(self) -> None:
        self.is_made = False

    def make(self) -> None:
        """Set `is_made`; callable while a signal is handled."""
        self.is_made = True


class Service:
    """Carries frames and time between a bus and a bench until a stop is requested."""

    def __init__(
        self,
        bench: Bench,
        bus: Bus,
        departure: Departure,
        clock: Clock,
        clock_mode: ClockMode,
        stop: StopRequest,
        is_once: bool = False,
    ) -> None:
        """`departure`: where the bench puts its frames.

        `is_once`: end also when all nodes have been Operational and then neither drive is, for whatever cause, or when
        the host is silent for `SILENCE_NS`.
        """
        self._bench = bench
        self._bus = bus
        self._departure = departure
        self._clock = clock
        self._is_wall = clock_mode == "wall"
        self._stop = stop
        self._is_once = is_once
        self._has_been_operational = False
        self._time_ns = 0  # up to here the bench's time has followed the clock
        self._heard_ns = 0  # last frame
        self._gone_ns = NEVER_NS  # when the host was found to have gone
        self.is_host_lost = False
        """Whether a host was silent for `SILENCE_NS` while a drive was Operational."""

    def boot(self) -> None:
        """Drop frames that wait on the bus, power the bench on, and send the boot-up messages.

        Raises BusError if the bus can't receive or send.
        """
        while self._bus.receive(0.0) is not None and not self._stop.is_made:
            pass
        self._time_ns = self._heard_ns = self._clock.now_ns()
        self._bench.boot(self._time_ns)
        self._departure.send_waiting()

    def run(self) -> None:
        """Carry frames and time until a stop is requested; `is_once` also ends it when the host has gone.

        In the latter case it first waits until the arm is at rest, about `LONGEST_ORPHANAGE_NS` at most. Waits for an
        interface that has gone down. Raises BusError for other failures of the bus.
        """
        while not self._stop.is_made:
            try:
                frame = self._serve()
            except InterfaceDownError:
                self._await_interface()
                continue
            if self._is_once and frame is None and self._is_host_gone() and self._is_settled():
                return

    def _serve(self) -> Frame | None:
        """Wait for one frame, pass it and the time to the bench, and send the answers.

        Returns the frame, None if none came in time.
        """
        bench = self._bench
        cycle = bench.cycle
        frame = self._bus.receive(self._patience_s())
        if frame is not None:
            self._heard_ns = frame.t_ns
            bench.on_frame(frame)
            self._has_been_operational = self._has_been_operational or bench.is_operational
        if bench.cycle != cycle:
            self._time_ns = self._heard_ns
        else:
            self._pass_time(self._clock.now_ns() if frame is None else frame.t_ns, frame is None)
        self._departure.send_waiting()
        return frame

    def _await_interface(self) -> None:
        """Try every `_LONGEST_WAIT_NS` to recover the interface, until it is back or a stop is requested."""
        while not self._stop.is_made:
            try:
                self._bus.recover()
            except BusError:
                self._clock.sleep_until_ns(self._clock.now_ns() + _LONGEST_WAIT_NS)
            else:
                return

    def _patience_s(self) -> float:
        """Return how long to wait for a frame, s.

        In clock mode `sync` it is `_IDLE_NS`, in `wall` the time to the bench's next timer, `_LONGEST_WAIT_NS` at most.
        """
        if not self._is_wall:
            return _IDLE_NS * 1e-9
        due_ns = self._bench.due_ns - self._clock.now_ns()
        return max(0, min(due_ns, _LONGEST_WAIT_NS)) * 1e-9

    def _pass_time(self, now_ns: int, is_idle: bool) -> None:
        """Pass time to the bench: by wall clock if no frame came (`is_idle`), by SYNC if no SYNC came for `_IDLE_NS`.

        A host in lockstep sends the time itself. After a silence of `SILENCE_NS` the bench outlives the host, and
        lockstep ends.
        """
        is_silent = now_ns - self._heard_ns > SILENCE_NS
        if is_silent:
            self.is_host_lost = self.is_host_lost or not self._is_left
            self._bench.outlive_host()
        if self._bench.is_paced:
            self._time_ns = now_ns
            if is_silent:
                self._bench.release()
            return
        if self._is_wall:
            if is_idle:
                self._bench.advance_to(now_ns)
        elif now_ns - self._time_ns >= _IDLE_NS:
            self._bench.advance_to(self._bench.now_ns + now_ns - self._time_ns)
            self._time_ns = now_ns

    def _is_host_gone(self) -> bool:
        is_silent = self._clock.now_ns() - self._heard_ns > SILENCE_NS
        return self._has_been_operational and (is_silent or self._is_left)

    @property
    def _is_left(self) -> bool:
        return not any(device.is_operational for device in self._bench.devices[:JOINTS])

    def _is_settled(self) -> bool:
        """Return whether the arm of a host that has gone is at rest, or has had its time by wall clock.

        That time is `LONGEST_ORPHANAGE_NS`. In clock mode `sync` the first call lets the arm come to rest.
        """
        self._bench.outlive_host()
        self._departure.send_waiting()
        now_ns = self._clock.now_ns()
        self._gone_ns = min(self._gone_ns, now_ns)
        return not self._is_wall or self._bench.is_at_rest or now_ns - self._gone_ns > LONGEST_ORPHANAGE_NS


def open_devices_end(interface: str, channel: str, clock: Clock, codec: Codec) -> Bus:
    """Return the devices' end of a bus, open.

    It hears the host's frames, marks and possible RPDOs; CAN FD only if the contract has such frames. Raises
    BusMissingError if the interface or channel is missing, down or unusable.
    """
    heard = {message.can_id for message in codec.messages.values() if "HOST" in message.senders} | LISTENED_IDS
    heard.add(HOST_MARK)
    return open_bus(interface, channel, clock, sorted(heard), is_fd=codec.is_fd)
