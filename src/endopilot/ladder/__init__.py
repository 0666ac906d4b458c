"""The ladder: navigation tasks in unseen patients, and the scores of policies on them."""
