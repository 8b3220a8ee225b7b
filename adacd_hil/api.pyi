from adacd_hil.lab.detectors.detector_registry import StreamDetector as Detector
from adacd_hil.lab.detectors.detector_registry import check_contract as check_detector
from adacd_hil.lab.detectors.detector_registry import register as register_detector
from adacd_hil.lab.library.array_detection import ArrayContact, ArrayError, detect, fit
from adacd_hil.lab.library.array_detection import ArrayDetection as Detection
from adacd_hil.lab.library.array_detection import FittedModel as Model
from adacd_hil.lab.library.array_detection import OfflineArm as Arm
from adacd_hil.lab.library.loaded_run import LoadedRun, RunContact, RunEvent, load
from adacd_hil.lab.offline.recording_verdict import Verdict
from adacd_hil.log.log_files import LogError
from adacd_hil.records import ContactReport, SchemeState
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.wire.bus import Bus, Frame

__all__ = [
    "Arm",
    "ArrayContact",
    "ArrayError",
    "Bus",
    "Certificate",
    "ContactReport",
    "Detection",
    "Detector",
    "Frame",
    "LoadedRun",
    "LogError",
    "Model",
    "RunContact",
    "RunEvent",
    "SchemeState",
    "Verdict",
    "check_detector",
    "detect",
    "fit",
    "load",
    "register_detector",
]
