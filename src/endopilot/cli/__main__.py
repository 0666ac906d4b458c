"""`python -m endopilot.cli`, for where the `endopilot` script is not on the path."""

from endopilot.cli import main

main()
