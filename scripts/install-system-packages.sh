#!/bin/sh
# Installs Debian packages where that is allowed (root, or sudo without a password); otherwise says in one line what to install.
# Usage: install-system-packages.sh REASON PACKAGE...
set -eu

reason=$1
shift

give_up() {
    echo "skugga: $reason; $1" >&2
    exit 1
}

command -v apt-get >/dev/null || give_up "install what Debian calls '$*' with your package manager, then run make again"

if [ "$(id -u)" -eq 0 ]; then
    as_root="env DEBIAN_FRONTEND=noninteractive"
elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
    as_root="sudo -n env DEBIAN_FRONTEND=noninteractive"
else
    give_up "run 'sudo apt-get install $*', then make again"
fi

echo "skugga: $reason; installing $*"
# The package index may be missing or old on a fresh machine. A source that cannot be reached matters only if the install fails.
$as_root apt-get update -qq || true
$as_root apt-get install -y -qq --no-install-recommends "$@" </dev/null >/dev/null ||
    give_up "'apt-get install $*' failed (its reason is above)"
