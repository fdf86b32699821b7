"""Scenario files: reads YAML as a team and settings, writes a team as YAML, and holds the packaged scenarios."""

from consat.scenario.files import Scenario, load, loads, located, packaged, packaged_text, template
from consat.scenario.writing import dump

__all__ = ["Scenario", "dump", "load", "loads", "located", "packaged", "packaged_text", "template"]
