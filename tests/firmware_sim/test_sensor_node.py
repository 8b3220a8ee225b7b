"""The emulated torque sensor: protected frames, status, zero; checked with cantools where it has an opinion."""

import struct

import numpy as np
import pytest
from bench_host import BenchHost, Nmt, quiet_scenario

ZERO = int.from_bytes(b"zero", "little")


def torque_frames(host: BenchHost, count: int, node: int = 3) -> list[bytes]:
    host.take()
    host.sync(times=count)
    return host.taken(0x180 + node)


def torque_uNm(frame: bytes) -> int:
    return struct.unpack_from("<i", frame, 2)[0]


def test_the_value_is_the_converters_count_in_micronewtonmetres():
    host = BenchHost(quiet_scenario(torque_offset_Nm=[1.0, -2.0]))
    host.nmt(Nmt.START)
    lsb_uNm = 100e6 / 65536
    assert torque_uNm(torque_frames(host, 1, 3)[0]) == round(round(1e6 / lsb_uNm) * lsb_uNm)
    assert torque_uNm(torque_frames(host, 1, 4)[0]) == round(round(-2e6 / lsb_uNm) * lsb_uNm)
    assert host.read(3, 0x9130, 1) == pytest.approx(1e6, abs=lsb_uNm)


def test_a_sensor_of_a_larger_range_sends_the_torque_in_coarser_steps():
    host = BenchHost(quiet_scenario(torque_offset_Nm=[10.0, 0.0], sensors={"torque_range_Nm": [100.0, 50.0]}))
    host.nmt(Nmt.START)
    assert torque_uNm(torque_frames(host, 1, 3)[0]) == pytest.approx(10e6, abs=200e6 / 65536)


@pytest.mark.parametrize(("range_Nm", "bits"), [(50.0, 16), (20.0, 12)])
@pytest.mark.parametrize("beyond_Nm", [-0.1, 0.0, 15.0])
@pytest.mark.parametrize(("way", "overload"), [(1.0, 0x03), (-1.0, 0x05)])
def test_an_overload_is_flagged_in_the_frame_itself_and_in_the_status(range_Nm, bits, beyond_Nm, way, overload):
    sensors = {"torque_range_Nm": [range_Nm, 50.0], "torque_bits": [bits, 16]}
    offset_Nm = way * min(range_Nm + beyond_Nm, 50.0)
    host = BenchHost(quiet_scenario(torque_offset_Nm=[offset_Nm, 0.0], sensors=sensors))
    host.nmt(Nmt.START)
    host.take()
    host.sync()
    frames = host.take()
    torque = next(data for can_id, data in frames if can_id == 0x183)
    status = overload if beyond_Nm >= 0.0 else 0
    assert torque[1] >> 4 == status
    value_uNm, step_uNm = way * 1e6 * (range_Nm + min(beyond_Nm, 0.0)), 2e6 * range_Nm / 2**bits
    assert torque_uNm(torque) == pytest.approx(value_uNm, abs=1.1 * step_uNm)
    assert host.read(3, 0x6150, 1) == status
    assert [data for can_id, data in frames if can_id == 0x283] == [bytes([status, 0])]


def test_before_the_first_sample_the_value_is_not_valid():
    host = BenchHost()
    host.nmt(Nmt.START)
    assert host.taken(0x283) == [b"\x01\x00"]
    host.sync()
    assert host.taken(0x283) == [b"\x00\x00"]


@pytest.mark.parametrize("command", [Nmt.RESET_COMMUNICATION, Nmt.RESET_NODE])
def test_the_counter_goes_on_over_a_pause_and_begins_anew_after_a_reset(command):
    host = BenchHost()
    host.nmt(Nmt.START)
    torque_frames(host, 3)
    host.nmt(Nmt.PRE_OPERATIONAL)
    torque_frames(host, 5)
    host.nmt(Nmt.START)
    assert torque_frames(host, 1)[0][1] & 0x0F == 3
    host.nmt(command)
    host.nmt(Nmt.START)
    assert torque_frames(host, 1)[0][1] & 0x0F == 0


def test_autozero_takes_the_mean_of_64_samples_for_zero():
    host = BenchHost(quiet_scenario(noise=True, torque_offset_Nm=[3.0, 0.0], seed=5))
    host.nmt(Nmt.START)
    before = torque_frames(host, 200)
    assert np.mean([torque_uNm(frame) for frame in before]) == pytest.approx(3e6, abs=10e3)
    host.nmt(Nmt.PRE_OPERATIONAL, 3)
    host.write(3, 0x6125, 1, ZERO)
    host.nmt(Nmt.START, 3)
    torque_frames(host, 64)
    after = torque_frames(host, 1000)
    assert np.mean([torque_uNm(frame) for frame in after]) == pytest.approx(0.0, abs=4 * 20e3 / 64**0.5)


def test_a_zeroed_sensor_still_reports_the_overload_of_its_converter():
    host = BenchHost(quiet_scenario(torque_offset_Nm=[50.0, 0.0]))
    host.write(3, 0x6125, 1, ZERO)
    host.nmt(Nmt.START)
    assert torque_frames(host, 65)[-1][1] >> 4 == 0x03
