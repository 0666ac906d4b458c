"""Speed and accuracy of every stage, each figure beside its bar."""
