"""Networks that predict the wire's tip from the drive's motion and back: configured, trained and rolled out here."""
