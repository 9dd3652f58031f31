"""Options of all stages of a pair."""

from __future__ import annotations

from planish.options import Options
from planish.registration.consensus import ConsensusOptions
from planish.registration.dense.match import DenseOptions
from planish.registration.keypoints.detect import KeypointOptions
from planish.registration.match.matching import MatchOptions
from planish.registration.refine.solve import RefineOptions
from planish.registration.surface import SurfaceOptions
from planish.registration.texture.charts import ChartOptions
from planish.registration.texture.photometric import PhotometricOptions
from planish.registration.verdict.judge import VerdictOptions


class PairOptions(Options):
    """Options of all stages of a pair."""

    surface: SurfaceOptions = SurfaceOptions()
    photometric: PhotometricOptions = PhotometricOptions()
    charts: ChartOptions = ChartOptions()
    keypoints: KeypointOptions = KeypointOptions()
    match: MatchOptions = MatchOptions()
    dense: DenseOptions = DenseOptions()
    consensus: ConsensusOptions = ConsensusOptions()
    refine: RefineOptions = RefineOptions()
    verdict: VerdictOptions = VerdictOptions()
