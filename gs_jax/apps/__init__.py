"""Applications that stand on the library; nothing else imports them."""
