"""What the reports of all stages share: page template and style, pictures."""
