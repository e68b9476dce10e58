"""Files of other tools: models and configurations in and out, with a report of what they mean here."""
