"""What the site needs besides what Sphinx has."""
