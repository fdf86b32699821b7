"""The command line: words in and words out, no mathematics. `main` has the commands of one process, `network` those of many."""
