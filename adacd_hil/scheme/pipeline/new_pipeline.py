"""The pipeline of the scheme that the settings select."""

from adacd_hil.scheme.pipeline.certified_pipeline import CertifiedPipeline
from adacd_hil.scheme.pipeline.paper_pipeline import PaperPipeline
from adacd_hil.scheme.pipeline.pipeline import Pipeline
from adacd_hil.settings.configuration import Settings


def new_pipeline(settings: Settings) -> Pipeline:
    """Return the pipeline of the certified scheme if `settings.scheme` is `certified`, else of the paper's.

    It is new: as before the first cycle of a run.
    """
    return CertifiedPipeline(settings) if settings.scheme == "certified" else PaperPipeline(settings)
