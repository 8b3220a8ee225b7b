"""Public names for scripts and packages of a lab: runs as arrays, the scheme over arrays, plug-ins.

Everything else may move; these names stay. docs/api.md has examples.

| name | is |
|---|---|
| `load`, `LoadedRun` | a run's log as named arrays, events, contacts, certificates |
| `detect`, `fit`, `Arm`, `Detection`, `Model`, `Verdict`, `ArrayError` | the scheme over arrays of any serial arm |
| `Detector`, `register_detector`, `check_detector` | a detector of your own |
| `Bus`, `Frame` | another CAN interface |
| `RunContact`, `RunEvent`, `ArrayContact` | contacts and events in these results |
| `SchemeState`, `ContactReport`, `Certificate`, `LogError` | types of the results |
"""

_LIBRARY = "adacd_hil.lab.library"
PLACES = {
    "Arm": (f"{_LIBRARY}.array_detection", "OfflineArm"),
    "ArrayContact": (f"{_LIBRARY}.array_detection", "ArrayContact"),
    "ArrayError": (f"{_LIBRARY}.array_detection", "ArrayError"),
    "Bus": ("adacd_hil.wire.bus", "Bus"),
    "Certificate": ("adacd_hil.scheme.identify.certificate", "Certificate"),
    "ContactReport": ("adacd_hil.records", "ContactReport"),
    "Detection": (f"{_LIBRARY}.array_detection", "ArrayDetection"),
    "Detector": ("adacd_hil.lab.detectors.detector_registry", "StreamDetector"),
    "Frame": ("adacd_hil.wire.bus", "Frame"),
    "LoadedRun": (f"{_LIBRARY}.loaded_run", "LoadedRun"),
    "LogError": ("adacd_hil.log.log_files", "LogError"),
    "Model": (f"{_LIBRARY}.array_detection", "FittedModel"),
    "RunContact": (f"{_LIBRARY}.loaded_run", "RunContact"),
    "RunEvent": (f"{_LIBRARY}.loaded_run", "RunEvent"),
    "SchemeState": ("adacd_hil.records", "SchemeState"),
    "Verdict": ("adacd_hil.lab.offline.recording_verdict", "Verdict"),
    "check_detector": ("adacd_hil.lab.detectors.detector_registry", "check_contract"),
    "detect": (f"{_LIBRARY}.array_detection", "detect"),
    "fit": (f"{_LIBRARY}.array_detection", "fit"),
    "load": (f"{_LIBRARY}.loaded_run", "load"),
    "register_detector": ("adacd_hil.lab.detectors.detector_registry", "register"),
}
__all__ = list(PLACES)


def __getattr__(name: str) -> object:
    """Return a public name, imported only now: some modules compile functions, some import plot libraries.

    Raises AttributeError for a name that isn't public.
    """
    if name not in PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; there are {', '.join(__all__)}")
    from importlib import import_module

    module, attribute = PLACES[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted(__all__)
