#!/bin/bash
# The Debian package on a machine with systemd as PID 1, from installing to purging. Runs as root in a throw-away guest that has
# the vivid test camera (it fills /dev/shm, reloads drivers and purges the package):
#
#   service.sh DEB                 everything up to the reboot; leaves the service enabled
#   service.sh DEB after-reboot    what must have survived; purges at the end
#
# Beside DEB may lie cairn-tools.deb, of both a later version, cairn-next.deb and cairn-tools-next.deb, and cairn-bridge.deb.
#
# One line a check, `ok NAME` or `FAIL NAME: why`; exits 1 if one failed. Times are this machine's clock.
deb=${1:?usage: service.sh DEB [after-reboot]}
failed=0
log=/run/service-check.log

check() { # NAME COMMAND...: ok if it succeeds
    local name=$1
    shift
    if "$@" >"$log" 2>&1; then
        echo "ok $name"
    else
        failed=1
        echo "FAIL $name: $(tail -n 5 "$log" | tr '\n' ' ')"
    fi
}
within() { # SECONDS COMMAND...: waits until it succeeds
    local end=$((SECONDS + $1))
    shift
    until "$@"; do
        [ $SECONDS -lt $end ] || { "$@"; systemctl status cairn --no-pager -n 5; return 1; }
        sleep 0.2
    done
}
show() { systemctl show cairn -p "$1" --value; }
is() { # PROPERTY VALUE
    local now
    now=$(show "$1")
    [ "$now" = "$2" ] || { echo "$1 is '$now', not '$2'"; return 1; }
}
status_has() { show StatusText | grep -q -- "$1"; }
status_lacks() { [ -n "$(show StatusText)" ] && ! status_has "$1"; }
logged() { # MATCH...: a record with all these fields, since this start of the check
    journalctl -q -u cairn -b --since "$since" -o json "$@" | grep -q .
}
as() { # USER COMMAND...
    local user=$1
    shift
    runuser -u "$user" -- "$@"
}
says() { # WORDS COMMAND...: its output contains the words, whatever its exit code
    local words=$1 text
    shift
    text=$("$@" 2>&1)
    grep -qF -- "$words" <<<"$text" || { echo "'$words' not in: $(tail -n 12 <<<"$text")"; return 1; }
}
now_ms() { echo $(($(date +%s%N) / 1000000)); }
settings() { # config of a small test camera, with further lines
    printf '[camera]\nwidth_px = 320\nheight_px = 180\nrate_hz = 15.0\n%s\n' "$1" >/etc/cairn/cairn.toml
}
calibration='width_px = 320\nheight_px = 180\nfx_px = 300.0\nfy_px = 300.0\ncx_px = 159.5\ncy_px = 89.5\ndistortion = [0.0, 0.0, 0.0, 0.0, 0.0]\n'
plug() { modprobe vivid n_devs=1 node_types=0x1 num_inputs=1 input_types=0 && udevadm settle; }
flowing() { as cairn cairn watch --json --timeout 10 --count 5 | grep -q '"sequence"'; }
finish() { [ $failed = 0 ] && echo "done" || echo "some checks failed"; exit $failed; }

since=$(date '+%F %T')

if [ "$2" = after-reboot ]; then
    check "starts at boot" within 30 is ActiveState active
    check "folder made again at boot" test "$(stat -c '%U:%G %a' /tmp/iceoryx2)" = "cairn:cairn 750"
    check "what an older boot left is gone" test ! -e /tmp/iceoryx2/of-an-older-boot
    since=$(date -d '10 minutes ago' '+%F %T')
    check "stored calibration found again" within 20 logged MESSAGE="stored calibration used"
    check "frames flow after the reboot" within 30 status_lacks NO_
    check "planners hear it after the reboot" flowing
    check "log of the boot before is kept" journalctl -q -u cairn -b -1 MESSAGE=running -n 1
    rm /etc/cairn/vivid.toml # not the package's
    check "purge" dpkg --purge cairn
    check "nothing stays" bash -c '! ls -d /usr/bin/cairn /etc/cairn /var/lib/cairn /usr/lib/systemd/system/cairn.service'
    check "nothing runs" bash -c '! pgrep -ax cairn'
    finish
fi

# --- installing
check "install" dpkg -i "$deb"
check "user cairn may use cameras" says video id -nG cairn
check "folder of iceoryx2 is the user's alone" test "$(stat -c '%U:%G %a' /tmp/iceoryx2)" = "cairn:cairn 750"
check "installing starts nothing" is ActiveState inactive
check "configuration is a conffile" says /etc/cairn/cairn.toml dpkg-query -W -f '${Conffiles}' cairn
check "doctor: service inactive" says "sudo systemctl start cairn" cairn doctor
exposure=$(systemd-analyze security --offline=true /usr/lib/systemd/system/cairn.service | grep -o 'level for.*: [0-9.]*' | grep -o '[0-9.]*$')
check "exposure $exposure is below 2.0" awk -v e="$exposure" 'BEGIN { exit !(e != "" && e < 2.0) }'

# --- the tools beside it
tools=${deb%/*}/cairn-tools.deb
check "a command of the tools is answered with where it is" says '`cairn-tools demo`' cairn demo
if [ -f "$tools" ]; then
    check "tools: install" dpkg -i "$tools"
    check "tools: of the same version" test "$(cairn --version)" = "$(cairn-tools --version)"
    check "tools: what the robot's build lacks" says "Length, s" cairn-tools demo --help
    is_console() { test "$(systemctl show cairn-console -p "$1" --value)" = "$2"; }
    page() { python3 -c 'import urllib.request as u; print(u.urlopen("http://127.0.0.1:7979/", timeout=5).read().decode())'; }
    check "console: off as installed" is_console ActiveState inactive
    check "console: not enabled" is_console UnitFileState disabled
    check "console: start" systemctl start cairn-console
    served() { says "<title>Cairn</title>" page; }
    check "console: the page is served" within 20 served
    console=$(systemctl show cairn-console -p MainPID --value)
    check "console: upgrade" dpkg -i "$tools"
    check "console: an upgrade restarts it" bash -c '! test -d /proc/'"$console"
    check "console: served again" within 20 served
    check "console: stop" systemctl stop cairn-console
    check "console: an upgrade" dpkg -i "$tools"
    check "console: an upgrade does not start it" is_console ActiveState inactive
    systemctl start cairn-console
    check "tools: purge" dpkg --purge cairn-tools
    check "console: purged while it ran" bash -c '! pgrep -x cairn-tools && ! test -e /usr/lib/systemd/system/cairn-console.service'
    check "tools: only they are gone" test ! -e /usr/bin/cairn-tools -a -x /usr/bin/cairn -a -e /etc/cairn/cairn.toml
fi

# --- the bridge beside it
bridge=${deb%/*}/cairn-bridge.deb
check "a command of the bridge is answered with where it is" says '`cairn-bridge bridge`' cairn bridge
if [ -f "$bridge" ]; then
    unit=/usr/lib/systemd/system/cairn-bridge.service
    is_bridge() { test "$(systemctl show cairn-bridge -p "$1" --value)" = "$2"; }
    verified() { # nothing is said of the unit
        local text
        text=$(systemd-analyze verify --man=no "$unit" 2>&1) || { echo "$text"; return 1; }
        if grep -F cairn-bridge <<<"$text"; then return 1; fi
    }
    check "bridge: install" dpkg -i "$bridge"
    check "bridge: of the same version" test "$(cairn --version)" = "$(cairn-bridge --version)"
    check "bridge: help" cairn-bridge --help
    check "bridge: what the robot's build lacks" says "--robot" cairn-bridge bridge --help
    check "bridge: its unit" test -f "$unit"
    check "bridge: the unit is right" verified
    check "bridge: the unit starts what the package brings" grep -qx "ExecStart=/usr/bin/cairn-bridge bridge" "$unit"
    check "bridge: off as installed" is_bridge ActiveState inactive
    check "bridge: not enabled" is_bridge UnitFileState disabled
    check "bridge: purge" dpkg --purge cairn-bridge
    check "bridge: only it is gone" test ! -e /usr/bin/cairn-bridge -a ! -e "$unit" -a -x /usr/bin/cairn -a -e /etc/cairn/cairn.toml
fi

# --- no camera yet
printf "$calibration" >/etc/cairn/vivid.toml
settings '[calibration]
file = "/etc/cairn/vivid.toml"'
modprobe -r vivid 2>/dev/null
began=$(now_ms)
check "start without a camera" systemctl start cairn
echo "ready without a camera after $(($(now_ms) - began)) ms"
check "status says NO_CAMERA" within 5 status_has NO_CAMERA
check "journal: FAULT, ADVICE, PRIORITY" within 5 logged FAULT=NO_CAMERA PRIORITY=4
check "journal: advice is a field" says '"ADVICE"' journalctl -q -u cairn -b FAULT=NO_CAMERA -o json
check "journal: names ours" says '"SYSLOG_IDENTIFIER":"cairn"' journalctl -q -u cairn -b -n 1 -o json _COMM=cairn
check "doctor hears NO_CAMERA" says "the daemon reports NO_CAMERA" as cairn cairn doctor
check "doctor of root names the user" says "sudo -u cairn cairn watch" cairn doctor

# --- plugged in
plug
check "camera rule" test "$(stat -c '%G %a' /dev/video0)" = "video 660"
check "frames flow" within 15 status_lacks NO_
check "planners of the user hear it" flowing
check "root is told why it hears nothing" says cairn cairn watch --count 1 --timeout 3
check "journal: STATE" within 10 logged STATE=INITIALIZING STATE=ORIENTATION PRIORITY=6
check "doctor hears no fault" says "and no fault" as cairn cairn doctor
check "doctor finds nothing to do" says "has all it needs" as cairn cairn doctor
check "doctor of root sees who has the camera" says "is used by a daemon (pid $(show MainPID))" cairn doctor
pid=$(show MainPID)
echo "privileges: $(grep -E 'CapEff|NoNewPrivs|Seccomp:' /proc/$pid/status | tr -s '\t\n' ' ')"

# --- reload
settings '[calibration]
file = "/etc/cairn/vivid.toml"
[log]
level = "debug"'
check "reload" systemctl reload cairn
check "new level at once" within 5 logged PRIORITY=7
settings '[calibration]
file = "/etc/cairn/vivid.toml"
[features]
max_tracks = 200'
systemctl reload cairn
check "what needs a restart is named" within 5 logged MESSAGE="changes need a restart of the daemon" KEYS=features.max_tracks PRIORITY=4
echo '[camera' >>/etc/cairn/cairn.toml
systemctl reload cairn
check "a broken file changes nothing" within 5 logged MESSAGE="configuration not reloaded, the old one stays" PRIORITY=3
check "same process all along" is MainPID "$pid"
settings '[calibration]
file = "/etc/cairn/vivid.toml"'

# --- upgraded to a later version while daemon and console run, and somebody has changed the configuration
next=${deb%/*}/cairn-next.deb
tools_next=${deb%/*}/cairn-tools-next.deb
if [ -f "$next" ] && [ -f "$tools_next" ]; then
    version() { dpkg-query -W -f '${Version}' "$1"; }
    later() { dpkg --compare-versions "$(version "$1")" gt "$2" || { echo "$1 is $(version "$1"), was $2"; return 1; }; }
    main_pid() { systemctl show "$1" -p MainPID --value; }
    running() { kill -0 "$(main_pid "$1")" && [ "$(systemctl is-active "$1")" = active ]; }
    anew() { running "$1" && [ "$(main_pid "$1")" != "$2" ]; }
    check "upgrade: the tools beside it" dpkg -i "$tools"
    check "upgrade: console: start" systemctl start cairn-console
    check "upgrade: console: served" within 20 served
    was=$(version cairn)
    console=$(main_pid cairn-console)
    as cairn touch /var/lib/cairn/kept
    before=$(sha256sum /etc/cairn/cairn.toml /etc/cairn/vivid.toml)
    began=$(now_ms)
    check "upgrade: daemon" dpkg -i "$next"
    check "upgrade: daemon: later than before" later cairn "$was"
    check "upgrade: daemon: runs anew" within 10 anew cairn "$pid"
    check "upgrade: daemon: frames" within 15 status_lacks NO_
    echo "frames again $(($(now_ms) - began)) ms after the upgrade began"
    check "upgrade: daemon: planners hear it" flowing
    check "upgrade: daemon: not enabled by it" says disabled systemctl is-enabled cairn
    check "upgrade: the console has gone on" test "$(main_pid cairn-console)" = "$console" -a "$(systemctl is-active cairn-console)" = active
    pid=$(show MainPID)
    was=$(version cairn-tools)
    check "upgrade: tools" dpkg -i "$tools_next"
    check "upgrade: tools: later than before" later cairn-tools "$was"
    check "upgrade: console: runs anew" within 10 anew cairn-console "$console"
    check "upgrade: console: served again" within 20 served
    check "upgrade: console: not enabled by it" says disabled systemctl is-enabled cairn-console
    check "upgrade: the daemon has gone on" is MainPID "$pid"
    check "upgrade: configuration as it was" test "$(sha256sum /etc/cairn/cairn.toml /etc/cairn/vivid.toml)" = "$before"
    check "upgrade: state as it was" test -e /var/lib/cairn/kept
    check "upgrade: nothing left half done" bash -c '[ -z "$(dpkg --audit)" ] && ! ls /etc/cairn/*.dpkg-*'
    check "upgrade: console: stop" systemctl stop cairn-console
    systemctl stop cairn
    check "upgrade: another version of what is stopped" dpkg -i "$deb" "$tools"
    check "upgrade: another version of what is stopped starts nothing" test "$(systemctl is-active cairn)$(systemctl is-active cairn-console)" = inactiveinactive
    check "upgrade: tools purged" dpkg --purge cairn-tools
    systemctl start cairn
    check "upgrade: start again" within 10 running cairn
    check "upgrade: frames of the start" within 15 status_lacks NO_
    pid=$(show MainPID)
fi

# --- kill, hang, stop
began=$(now_ms)
kill -9 "$pid"
check "restarts after kill -9" within 10 is NRestarts 1
check "active again" within 10 is ActiveState active
check "frames again" within 10 status_lacks NO_
echo "frames again $(($(now_ms) - began)) ms after kill -9"
check "planners again" flowing
kill -STOP "$(show MainPID)"
check "watchdog ends a daemon that hangs" within 30 is NRestarts 2
check "active after the watchdog" within 10 is ActiveState active
check "frames after the watchdog" within 15 status_lacks NO_
began=$(now_ms)
systemctl stop cairn
took=$(($(now_ms) - began))
check "stop took $took ms, less than 1000" test $took -lt 1000
check "it ended by itself" is Result success
nothing_in() { local left; left=$(find "$@"); [ -z "$left" ] || { echo "$left"; return 1; }; }
# iceoryx2 itself keeps one file for all its nodes.
check "no shared memory is left" nothing_in /dev/shm -type f ! -name 'iox2_*.global_mgmt'

# --- what doctor explains
v4l2-ctl -d /dev/video0 --stream-mmap --stream-count=3000 >/dev/null 2>&1 &
holder=$!
sleep 1
check "doctor: busy, and by whom" says "v4l2-ctl (pid $holder)" cairn doctor
kill $holder
wait $holder 2>/dev/null
check "doctor: pictures counted" says "pictures a second" as cairn cairn doctor
check "doctor: permission denied" says "usermod -aG video" as nobody cairn doctor
fallocate -l "$(($(df --output=avail -B1 /dev/shm | tail -1) - 1000000))" /dev/shm/filler
check "doctor: /dev/shm full" says "64 MB are needed" cairn doctor
rm /dev/shm/filler
rm -r /tmp/iceoryx2
as nobody mkdir /tmp/iceoryx2
check "doctor: folder of somebody else" says "belongs to user nobody" cairn doctor
check "tmpfiles takes the folder back" systemd-tmpfiles --create cairn.conf
check "it is the user's again" test "$(stat -c '%U:%G %a' /tmp/iceoryx2)" = "cairn:cairn 750"
check "a squatter cannot come back" bash -c '! runuser -u nobody -- mv /tmp/iceoryx2 /tmp/mine && ! runuser -u nobody -- touch /tmp/iceoryx2/x'
echo 'nonsense = 1' >>/etc/cairn/cairn.toml
systemctl start cairn
check "a wrong configuration is not tried again and again" within 5 is ActiveState failed
check "doctor: failed, and why" says "configuration or calibration is wrong" cairn doctor
check "journal: why it ended is an error" logged PRIORITY=3 SYSLOG_IDENTIFIER=cairn

# --- ageing, reboot
settings ''
mkdir -p /var/lib/cairn/cameras
printf "camera = \"card:vivid\"\n$calibration" >/var/lib/cairn/cameras/vivid.toml
chown -R cairn:cairn /var/lib/cairn
check "start with a stored calibration" systemctl restart cairn
check "stored calibration used" within 10 logged MESSAGE="stored calibration used"
echo 'q /tmp 1777 root root 10d' >/etc/tmpfiles.d/tmp.conf
touch -d '30 days ago' /tmp/old-file
find /tmp/iceoryx2 -exec touch -h -d '30 days ago' {} +
before=$(find /tmp/iceoryx2 | wc -l)
check "ageing" bash -c 'systemd-tmpfiles --clean; true'
check "ageing takes $before files of iceoryx2 not away" test "$before" -gt 1 -a "$(find /tmp/iceoryx2 | wc -l)" -eq "$before"
check "planners still hear it" flowing
as cairn touch /tmp/iceoryx2/of-an-older-boot
echo 'options vivid n_devs=1 node_types=0x1 num_inputs=1 input_types=0' >/etc/modprobe.d/vivid.conf
echo vivid >/etc/modules-load.d/vivid.conf
check "enable" systemctl enable cairn
finish
