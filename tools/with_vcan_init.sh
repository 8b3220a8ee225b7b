#!/bin/sh
# First process of the guest that with-vcan boots: sets up CAN, runs the job in $RUN_FOLDER, halts.
# Lines to the launcher: ttyS0 hangs up when it dies, ttyS1 and ttyS2 carry the job's output.
# What goes wrong here ends the guest without a status file; the reason is in the kernel log.
set -eu
PATH=/usr/sbin:/usr/bin:/sbin:/bin
cd "$RUN_FOLDER"
IFS="$IFS," # CAN_NAMES is separated by commas

mount_file_systems() {
    mount -t proc proc /proc
    mount -t sysfs sysfs /sys
    mountpoint -q /dev || mount -t devtmpfs devtmpfs /dev
    mkdir -p /dev/pts /dev/shm
    mount -t devpts -o ptmxmode=666 devpts /dev/pts
    mount -t tmpfs -o mode=1777 tmpfs /dev/shm
    mount -t tmpfs -o mode=755 tmpfs /run
    ln -sf /proc/self/fd /dev/fd
    ln -sf fd/0 /dev/stdin
    ln -sf fd/1 /dev/stdout
    ln -sf fd/2 /dev/stderr
}

# The kernel's own requests for modules (tc, ip link) take the same wrapper.
load_modules() {
    mkdir -p /run/kmod/lib
    ln -s /usr/lib/uml/modules /run/kmod/lib/modules
    printf '#!/bin/sh\nexec modprobe -d /run/kmod "$@"\n' >/run/modprobe
    chmod +x /run/modprobe
    echo /run/modprobe >/proc/sys/kernel/modprobe
    /run/modprobe -a can can-raw can-bcm can-gw vcan vxcan slcan
}

bring_up_network() {
    echo 16777216 >/proc/sys/net/core/rmem_max
    echo 16777216 >/proc/sys/net/core/wmem_max
    {
        echo link set lo up
        for name in $CAN_NAMES; do
            echo link add dev "$name" type vcan
            echo link set dev "$name" mtu 72 txqueuelen 4096 up
        done
    } | ip -batch -
}

# A frame crosses vcan in ksoftirqd once there are many of them; on its one CPU the guest would let it wait for the time
# slice of any ordinary process, 10 ms.
put_frames_first() {
    for folder in /proc/[0-9]*; do
        read -r name <"$folder/comm" || continue
        case $name in
        ksoftirqd/*) chrt --fifo --pid 90 "${folder#/proc/}" ;;
        esac
    done
}

# Raw lines carry every byte unchanged; pipes in front of them, as a job's output should not be a terminal.
connect_output() {
    stty -F /dev/ttyS1 raw -echo -hupcl
    stty -F /dev/ttyS2 raw -echo -hupcl
    mkfifo -m 666 /run/stdout /run/stderr
    cat /run/stdout >/dev/ttyS1 &
    stdout_pid=$!
    cat /run/stderr >/dev/ttyS2 &
    stderr_pid=$!
}

halt() {
    sync
    echo o >/proc/sysrq-trigger
}

halt_without_launcher() {
    read -r _ </dev/ttyS0 || true
    rm -rf "$RUN_FOLDER"
    halt
}

end_what_the_job_left() {
    for folder in /proc/[0-9]*; do
        pid=${folder#/proc/}
        case $pid in
        1 | "$stdout_pid" | "$stderr_pid") ;;
        *) kill -KILL "$pid" 2>/dev/null || true ;;
        esac
    done
}

mount_file_systems
load_modules
bring_up_network
put_frames_first
connect_output
halt_without_launcher &
ulimit -l unlimited
ulimit -r 99
: >ready

status=0
(exec >/run/stdout 2>/run/stderr && exec sh ./job) || status=$? # the subshell keeps "Killed" out of the output

end_what_the_job_left
while kill -0 "$stdout_pid" || kill -0 "$stderr_pid"; do
    sleep 0.01
    end_what_the_job_left
done 2>/dev/null
echo "$status" >status
halt
sleep 60
