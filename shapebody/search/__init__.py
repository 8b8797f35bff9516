"""Search for designs with a frozen agent: the objective, VGDS and its competitors."""

from shapebody.search.loop import Search
from shapebody.search.methods import METHODS, Method, SearchResult, search
from shapebody.search.objective import Objective
from shapebody.search.vgds import VGDSConfig

__all__ = ["METHODS", "Method", "Objective", "Search", "SearchResult", "VGDSConfig", "search"]
