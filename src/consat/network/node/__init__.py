"""A node of the network, which runs one agent: its part of the problem, neighbours, membership, timing of its steps, and body.

Input: a `part.Part`, messages, measurements. Output: messages, commands to the body. Start reading at `build`, which puts the objects
together: a core (the protocol), a station (neighbours, membership, body), a runner (when to step). Must not import `consat.network.deploy`.
"""
