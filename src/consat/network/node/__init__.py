"""One agent: its part of the problem, its neighbours, who is there, when it takes its turns, and its body.

In: a `part.Part`, messages, measurements. Out: messages, commands. Begin with `station`. May not import `consat.network.deploy`.
"""
