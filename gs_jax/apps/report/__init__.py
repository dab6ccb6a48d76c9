"""A microscope and what it showed as one page of HTML, that needs nothing but a browser."""
