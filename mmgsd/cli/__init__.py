"""What answers from a shell: the commands of ``python -m mmgsd`` that ask weights or make them, a function each."""
