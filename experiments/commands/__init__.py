"""What the commands of `hma` do. Each says what it wrote and what to run next; heavy imports happen here."""
