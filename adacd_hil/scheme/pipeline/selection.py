"""The choice of the scheme: which pipeline the settings ask for, and how its blocks are laid out."""

from adacd_hil.records import Layout, certified_layout, scheme_layout
from adacd_hil.scheme.pipeline.certified_pipeline import CertifiedPipeline
from adacd_hil.scheme.pipeline.paper_pipeline import Pipeline
from adacd_hil.settings.configuration import Settings


def pipeline_of(settings: Settings) -> Pipeline | CertifiedPipeline:
    """Make the pipeline that the settings ask for."""
    return CertifiedPipeline(settings) if settings.scheme == "certified" else Pipeline(settings)


def layout_of(settings: Settings) -> Layout:
    """Lay out the block of that pipeline."""
    count = len(settings.estimator.parameter_names)
    if settings.scheme == "certified":
        return certified_layout(count, settings.further_count, settings.channel_count)
    return scheme_layout(count)
