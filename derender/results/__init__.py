"""What inference found: a posterior, kept in files and handed to others."""
