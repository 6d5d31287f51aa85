"""The laboratory: trains, identifies, designs, recomputes the thesis. `tormag-lab` runs it, nothing else imports it."""
