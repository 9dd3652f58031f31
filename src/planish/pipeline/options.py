"""Options of the whole registration."""

from __future__ import annotations

from planish.registration.candidates.choose import CandidateOptions
from planish.registration.network.adjust import NetworkOptions
from planish.registration.options import PairOptions


class RegisterOptions(PairOptions):
    """Options of the whole registration: of which pairs, of the pairs and of the network."""

    candidates: CandidateOptions = CandidateOptions()
    network: NetworkOptions = NetworkOptions()
