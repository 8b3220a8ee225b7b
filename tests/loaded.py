"""The contract of a configuration, with the devices that it names."""

from adacd_hil.device.contract import load_contract
from adacd_hil.device.device_files import place_devices
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.codec import Codec


def loaded_contract(settings: Settings) -> Codec:
    return load_contract(settings, place_devices(settings))
