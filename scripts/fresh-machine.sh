#!/usr/bin/env bash
# Proves that the Makefile sets up a machine that has only Python, make and the package registries.
#
# Makes a minimal Debian in a folder, copies the working tree into it (what git tracks and what it does not ignore: as a
# fresh clone would be, with uncommitted work), and runs `make test` and `make run` there. Needs root, debootstrap and curl.
# What this machine uses to reach the registries (proxies, mirrors, certificates) is passed on.
set -euo pipefail

usage() {
    cat <<'TEXT'
Usage: scripts/fresh-machine.sh [--suite NAME] [--mirror URL] [--folder DIR] [--port N] [--keep] [-- COMMAND ...]

  --suite   Debian release (bookworm)
  --mirror  where debootstrap finds it (debootstrap's default)
  --folder  where to make the machine (a new folder under /tmp); one kept before is used again, with a new copy of the tree
  --port    for `make run`, on this machine's loopback (8765)
  --keep    leave the folder there
  COMMAND   to run in the copy instead of `make test` and `make run`, for example: bash .ci/run
TEXT
}

suite=bookworm
mirror=
folder=
port=8765
keep=
while [ $# -gt 0 ]; do
    case $1 in
        --suite) suite=$2; shift 2 ;;
        --mirror) mirror=$2; shift 2 ;;
        --folder) folder=$2; shift 2 ;;
        --port) port=$2; shift 2 ;;
        --keep) keep=yes; shift ;;
        --help|-h) usage; exit 0 ;;
        --) shift; break ;;
        *) usage >&2; exit 2 ;;
    esac
done

[ "$(id -u)" -eq 0 ] || { echo "fresh-machine: needs root" >&2; exit 1; }
for tool in debootstrap curl unshare git; do
    command -v "$tool" >/dev/null || { echo "fresh-machine: needs $tool" >&2; exit 1; }
done

tree=$(git -C "$(dirname "$0")/.." rev-parse --show-toplevel)
folder=${folder:-$(mktemp -d /tmp/fresh-machine.XXXXXX)}
root=$folder/root
home=$root/srv/skugga

running=
finish() {
    [ -z "$running" ] || kill -KILL -- "-$running" 2>/dev/null || true
    # Everything mounted lived in a mount namespace that is gone by now; --one-file-system makes sure all the same.
    [ -n "$keep" ] && echo "fresh-machine: kept in $folder" || rm -rf --one-file-system "$folder"
}
trap finish EXIT
trap 'exit 130' INT TERM

step() {
    local name=$1 start=$SECONDS status=0
    shift
    echo "== $name"
    "$@" || status=$?
    echo "== $name: $((SECONDS - start)) s$([ "$status" -eq 0 ] || echo ", FAILED with status $status")"
    return "$status"
}

make_machine() {
    mkdir -p "$root"
    debootstrap --variant=minbase --include=python3,make,ca-certificates "$suite" "$root" ${mirror:+"$mirror"} \
        >"$folder/debootstrap.log" 2>&1 || { tail -5 "$folder/debootstrap.log" >&2; return 1; }

    # The ways to the registries, and nothing else of this machine. Its list of sources fits only the same release.
    local file sources=()
    if grep -q "^VERSION_CODENAME=$suite$" /etc/os-release; then
        sources=(/etc/apt/sources.list /etc/apt/sources.list.d)
        rm -f "$root/etc/apt/sources.list"
    fi
    for file in "${sources[@]}" /etc/apt/apt.conf /etc/apt/apt.conf.d /etc/apt/auth.conf /etc/apt/auth.conf.d \
        /etc/apt/trusted.gpg.d /etc/apt/keyrings /usr/share/keyrings /etc/pip.conf /etc/resolv.conf \
        /etc/hosts /etc/ssl/certs /usr/local/share/ca-certificates /root/.npmrc /root/.pip /root/.config/pip; do
        [ -e "$file" ] || continue
        mkdir -p "$root$(dirname "$file")"
        rm -rf "${root:?}$file"
        cp -aL "$file" "$root$file" 2>/dev/null || cp -a "$file" "$root$file"
    done
}

copy_tree() {
    rm -rf "$home"
    mkdir -p "$home"
    git -C "$tree" ls-files -z --cached --others --exclude-standard |
        (cd "$tree" && xargs -0 -r ls -d 2>/dev/null | tar -c -T -) | tar -x -C "$home" --no-same-owner
}

# Becomes a shell command in the copy. Its mounts and processes live in namespaces of their own, and end with it however
# it ends.
become() {
    local passed=()
    mapfile -t passed < <(env | grep -E -i \
        '^((https?|ftp|all|no)_proxy|pip_[a-z_]*|npm_config_[a-z_]*|node_extra_ca_certs|ssl_cert_(file|dir)|requests_ca_bundle|curl_ca_bundle)=')
    # shellcheck disable=SC2016
    exec unshare --mount --pid --fork --kill-child bash -c '
        set -e
        root=$1; shift
        mount --make-rprivate /
        mount -t proc proc "$root/proc"
        mount --rbind /dev "$root/dev"
        exec chroot "$root" "$@"
    ' inside "$root" env -i HOME=/root PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin LANG=C.UTF-8 \
        "${passed[@]}" bash -c "cd /srv/skugga && $1" </dev/null
}

inside() {
    (become "$1")
}

# Starts `make run`, waits until it answers, and ends it.
run_and_look() {
    local log=$folder/run.log status=1 i
    rm -f "$folder/page.html"
    set -m  # a process group of its own, which can be ended as a whole
    # The shell is the first process of its namespace, which a signal without a handler does not end; hence the trap.
    become "trap : TERM; make run ARGS='--port $port'; exit" >"$log" 2>&1 &
    running=$!
    set +m
    for ((i = 0; i < 600; i++)); do
        kill -0 "$running" 2>/dev/null || break
        if curl --silent --fail --noproxy '*' --max-time 5 --output "$folder/page.html" "http://127.0.0.1:$port/"; then
            status=0
            break
        fi
        sleep 1
    done
    # The map itself: a tile of the bundled level, once a render process is ready.
    local tile="http://127.0.0.1:$port/levels/jacksboro/tiles/WebMercatorQuad/12/1089/1604.png"
    curl --silent --fail --noproxy '*' --max-time 60 --retry 20 --retry-delay 2 --retry-all-errors --output "$folder/tile.png" "$tile" ||
        { echo "fresh-machine: no tile came" >&2; status=1; }
    # SIGTERM first, as a service manager would. unshare itself ignores it; it ends when what it started has ended.
    kill -TERM -- "-$running" 2>/dev/null || true
    for ((i = 0; i < 20; i++)); do
        kill -0 "$running" 2>/dev/null || break
        sleep 1
    done
    if kill -0 "$running" 2>/dev/null; then
        echo "fresh-machine: the service did not stop within 20 s of SIGTERM" >&2
        kill -KILL -- "-$running" 2>/dev/null || true
        status=1
    fi
    wait "$running" 2>/dev/null || true
    running=
    tail -15 "$log"
    [ ! -s "$folder/tile.png" ] || echo "fresh-machine: a tile of $(wc -c <"$folder/tile.png") bytes"
    if [ -s "$folder/page.html" ]; then
        echo "fresh-machine: / answered with $(wc -c <"$folder/page.html") bytes, titled $(grep -o '<title>.*</title>' "$folder/page.html" || echo nothing)"
        [ -e "$home/api/static/index.html" ] || { echo "fresh-machine: the viewer was not built" >&2; status=1; }
    fi
    return "$status"
}

if curl --silent --noproxy '*' --max-time 2 --output /dev/null "http://127.0.0.1:$port/"; then
    echo "fresh-machine: something answers on port $port already; name another with --port" >&2
    exit 1
fi

[ -x "$root/usr/bin/python3" ] || step "debootstrap $suite" make_machine
step "copy the tree" copy_tree
if [ $# -gt 0 ]; then
    step "$*" inside "$*"
else
    # One failure does not hide what the other steps would say.
    failed=
    step "make test" inside "make test" || failed=yes
    step "nothing is set up twice" inside "make setup viewer" || failed=yes
    step "make run" run_and_look || failed=yes
    [ -z "$failed" ]
fi
