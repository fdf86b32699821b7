"""The live page: a session that steps in a thread of its own, and a web server that shows it and takes orders."""
