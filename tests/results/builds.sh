#!/usr/bin/env bash
# Builds the four releases, each cleanly in a folder of its own, and prints how large they are and how long it took,
# as a Markdown table.
#
#   tests/results/make builds     about twenty minutes on two cores, 3 GB in the temporary folder meanwhile; CARGO names another cargo
set -euo pipefail
cd "$(dirname "$0")/../.."
cargo=${CARGO:-cargo}
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
megabytes() { awk -v bytes="$(stat -c %s "$1")" 'BEGIN { printf "%.1f", bytes / 1e6 }'; }
load() { cut -d ' ' -f 1 /proc/loadavg; }

rows=
row() { # WHAT, FILE in release/, a cargo command with its options
    local what=$1 file=$folder/target/release/$2 options seconds crates
    shift 2
    options=$(printf '%s\n' "$@" | sed -n '/^--no-default-features$/p; /^--features$/{n;s/^/--features /p}' | tr '\n' ' ')
    rm -rf "$folder/target"
    # Cargo's own clock: waiting for another cargo is no building.
    CARGO_TARGET_DIR=$folder/target $cargo "$@" --locked 2>&1 </dev/null | tee "$folder/log" >&2
    seconds=$(sed -n 's/^ *Finished .* in //p' "$folder/log" | tail -n 1)
    strip --strip-unneeded -o "$folder/stripped" "$file"
    # shellcheck disable=SC2086 # words
    crates=$($cargo tree --locked --edges normal --prefix none --format '{p}' $options | sed 's/ (\*)$//' | sort -u | wc -l)
    rows+="| $what | $crates | $(megabytes "$folder/stripped") | $(megabytes "$file") | $seconds | $(load) |"$'\n'
}
row '`robot`, the package `cairn`' cairn build --release --bin cairn --no-default-features --features robot
row '`tools` (default), the package `cairn-tools`' cairn build --release --bin cairn
row '`bridge`, the package `cairn-bridge`' cairn build --release --bin cairn --no-default-features --features bridge
row '`client` with its C interface (`c`), `libcairn.so`' libcairn.so \
    rustc --release --lib --crate-type cdylib --no-default-features --features c

cat <<END
Release builds of nothing but the sources and the registry's cache, \`$(rustc --version | cut -d ' ' -f 1,2)\`. Crates: this one and
procedural macros included, what only build scripts need not. Unstripped: with line tables, which the packages keep in one of their own (\`-dbgsym\`). The load is the machine's average over the build's last
minute: more than the number of cores means that other work took its share of the time; waiting for another cargo counts in what it took, not in a build.

| build | crates | stripped MB | unstripped MB | clean build | load |
|---|---:|---:|---:|---:|---:|
${rows%$'\n'}
END
