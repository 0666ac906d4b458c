"""Speed and error of the rod core, alone and in environments, and how seldom it fails."""
