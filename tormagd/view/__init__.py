"""What a person looks at: dashboard, report, picture, and the page of a commissioning."""
