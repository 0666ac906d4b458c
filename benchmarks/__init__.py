"""Speed and error of every stage, each figure beside its bar: `python -m benchmarks --help` lists what is measured."""
