"""Extensions built on flexdt's public names: each subpackage is one subject and
independent."""
