"""Agents as processes: one agent (`process`), a whole team on this machine (`launch`), and their observation (`observer`, `dashboard`)."""
