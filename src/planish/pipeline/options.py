"""Options of the whole registration."""

from __future__ import annotations

from planish.registration.network.adjust import NetworkOptions
from planish.registration.pair import PairOptions


class RegisterOptions(PairOptions):
    """Options of the whole registration: of the pairs and of the network."""

    network: NetworkOptions = NetworkOptions()
