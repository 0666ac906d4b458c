"""`python -m endopilot.cli`, for where the `endopilot` script is not on the path."""

from endopilot.cli import main

if __name__ == "__main__":  # worker processes import this module too
    main()
