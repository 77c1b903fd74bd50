"""The command line: ``python -m gaigs +experiment=spectrum``."""

import sys

try:
    from gaigs.commands.command_line import main
except KeyboardInterrupt:
    print("gaigs: stopped", file=sys.stderr)
    raise SystemExit(130) from None

if __name__ == "__main__":
    main()
