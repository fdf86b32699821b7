"""Processes: an agent's own (`process`), a whole team's on this machine (`launch`), and who watches them (`observer`, `dashboard`)."""
