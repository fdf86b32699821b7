"""What a team is: agents and links, constraints in bulk as families, and groups of many agents alike.

All validation of input lives here. Begin with `team`; `groups` and `entries` lead a team's constraints into the families of `family`.
"""
