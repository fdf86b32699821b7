"""Robot models, simulators of their bodies, and what brings robots to their targets without touching: the safety filter, ways out of
deadlock, obstacles, paths.

In: targets, measured positions, a public map. Out: commands, states, a report of distances. Of consat it imports errors and numerics only.
"""

from consat.robots.conditions import conditions
from consat.robots.deadlock import Rules
from consat.robots.double import Double
from consat.robots.drive import Drive, Memory, Report
from consat.robots.fleet import Fleet
from consat.robots.obstacles import Obstacle, box, disc, polygon, start_faults
from consat.robots.planning import Planner
from consat.robots.point import Point
from consat.robots.quadrotor import Quadrotor
from consat.robots.simulated import Simulated, simulated
from consat.robots.unicycle import Unicycle

__all__ = [
    "Double",
    "Drive",
    "Fleet",
    "Memory",
    "Obstacle",
    "Planner",
    "Point",
    "Quadrotor",
    "Report",
    "Rules",
    "Simulated",
    "Unicycle",
    "box",
    "conditions",
    "disc",
    "polygon",
    "simulated",
    "start_faults",
]
