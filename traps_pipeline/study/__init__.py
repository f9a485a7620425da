"""What a person does with a study: say what is asked, count it, see where it stands, have it answered elsewhere."""
