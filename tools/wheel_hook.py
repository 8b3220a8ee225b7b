"""Adds the machine code that `tools/wheel` has compiled to the wheel, whose tag then names Python and platform."""

import os
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class MachineCodeHook(BuildHookInterface[Any]):
    """Part of the wheel's build; without ADACD_HIL_MACHINE_CODE, as in an editable install, it adds nothing."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002 (hatchling's signature)
        """Include the folder that ADACD_HIL_MACHINE_CODE names; it holds a folder named by the state of the sources."""
        folder = os.environ.get("ADACD_HIL_MACHINE_CODE")
        if folder:
            build_data["force_include"][folder] = "adacd_hil/machine_code"
            build_data["pure_python"], build_data["infer_tag"] = False, True
