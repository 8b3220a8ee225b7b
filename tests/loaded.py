"""The contract of a configuration, with the devices that it names, and frames by a contract."""

from adacd_hil.device.contract import load_contract
from adacd_hil.device.device_files import place_devices
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.codec import Codec, MessageCodec


def loaded_contract(settings: Settings) -> Codec:
    return load_contract(settings, place_devices(settings))


def encoded(message: MessageCodec, *values: float) -> bytearray:
    """Return a frame of physical values in the order of `message.values`; the end-to-end header is left zero."""
    pairs = zip(message.values, values, strict=True)
    return message.encode_raw(*(round((value - signal.offset) / signal.scale) for signal, value in pairs))
