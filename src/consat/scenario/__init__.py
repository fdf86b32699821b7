"""YAML ⇄ team and settings, and the packaged scenarios."""

from consat.scenario.files import Scenario, load, loads, located, packaged, packaged_text, template
from consat.scenario.writing import dump

__all__ = ["Scenario", "dump", "load", "loads", "located", "packaged", "packaged_text", "template"]
