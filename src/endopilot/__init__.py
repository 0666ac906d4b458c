"""endopilot: from a CT angiogram to an agent that drives an endovascular guidewire.

One stage is one package with one entry function, and data flows one way:

    imaging -> anatomy -> simulation -> dataset -> models -> evaluation

Units are mm, N, s, rad and HU; world coordinates are LPS mm throughout.
"""

__version__ = "0.1.0"
