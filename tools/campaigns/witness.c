// Writes what passes on a CAN interface to a file, with the kernel's receive stamps, in batches, so that it costs
// little beside the processes it watches. Usage: witness INTERFACE FILE ID...  (identifiers hexadecimal)
//
// A record: int64 CLOCK_REALTIME in ns, uint32 identifier, uint32 length, the first 8 data bytes. Says "ready" on
// stderr, ends by SIGINT or SIGTERM with one line of JSON: frames written, frames that the kernel dropped.
#define _GNU_SOURCE
#include <errno.h>
#include <inttypes.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>

enum { BATCH = 256, MOST_IDS = 64, BUFFER_BYTES = 32 << 20, PAUSE_NS = 5000000 };

struct record {
    int64_t wall_ns;
    uint32_t can_id;
    uint32_t length;
    uint8_t data[8];
};

static volatile sig_atomic_t is_stopped;

static void stop(int number) {
    (void)number;
    is_stopped = 1;
}

static void require(int result, const char *what) {
    if (result >= 0) return;
    fprintf(stderr, "witness: %s: %s\n", what, strerror(errno));
    exit(1);
}

int main(int argc, char **argv) {
    if (argc < 4 || argc - 3 > MOST_IDS) {
        fputs("usage: witness INTERFACE FILE ID...\n", stderr);
        return 2;
    }
    struct can_filter filters[MOST_IDS];
    for (int place = 3; place < argc; place++)
        filters[place - 3] = (struct can_filter){(canid_t)strtoul(argv[place], NULL, 16), CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG};
    const int yes = 1, bytes = BUFFER_BYTES;
    const int bus = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    require(bus, "this kernel has no SocketCAN");
    require(setsockopt(bus, SOL_CAN_RAW, CAN_RAW_FILTER, filters, (socklen_t)((size_t)(argc - 3) * sizeof *filters)), "filter");
    require(setsockopt(bus, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &yes, sizeof yes), "CAN FD");
    require(setsockopt(bus, SOL_SOCKET, SO_TIMESTAMPNS, &yes, sizeof yes), "receive stamps");
    require(setsockopt(bus, SOL_SOCKET, SO_RXQ_OVFL, &yes, sizeof yes), "count of drops");
    if (setsockopt(bus, SOL_SOCKET, SO_RCVBUFFORCE, &bytes, sizeof bytes) != 0)
        require(setsockopt(bus, SOL_SOCKET, SO_RCVBUF, &bytes, sizeof bytes), "buffer");
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(argv[1])};
    require(bind(bus, (struct sockaddr *)&address, sizeof address), argv[1]);
    FILE *file = fopen(argv[2], "wb");
    require(file == NULL ? -1 : 0, argv[2]);
    // Above ordinary work, below what is watched (80): it must not lose frames, nor disturb.
    sched_setscheduler(0, SCHED_FIFO, &(struct sched_param){.sched_priority = 1});
    signal(SIGINT, stop);
    signal(SIGTERM, stop);

    static struct canfd_frame frames[BATCH];
    static struct iovec places[BATCH];
    static struct mmsghdr incoming[BATCH];
    static union {
        char bytes[CMSG_SPACE(sizeof(struct timespec)) + CMSG_SPACE(sizeof(uint32_t))];
        struct cmsghdr aligned;
    } control[BATCH];
    for (int place = 0; place < BATCH; place++) {
        places[place] = (struct iovec){&frames[place], sizeof frames[place]};
        incoming[place].msg_hdr = (struct msghdr){.msg_iov = &places[place], .msg_iovlen = 1, .msg_control = &control[place]};
    }
    uint32_t lost = 0;
    uint64_t written = 0;
    fputs("ready\n", stderr);
    for (int is_over = 0; !is_over;) {
        is_over = is_stopped;  // what waits by then is still taken
        clock_nanosleep(CLOCK_MONOTONIC, 0, &(struct timespec){.tv_nsec = PAUSE_NS}, NULL);
        int arrived;
        do {
            for (int place = 0; place < BATCH; place++) incoming[place].msg_hdr.msg_controllen = sizeof control[place];
            arrived = recvmmsg(bus, incoming, BATCH, MSG_DONTWAIT, NULL);
            for (int place = 0; place < arrived; place++) {
                struct record row = {.can_id = frames[place].can_id, .length = frames[place].len};
                memcpy(row.data, frames[place].data, sizeof row.data);
                struct msghdr *header = &incoming[place].msg_hdr;
                for (struct cmsghdr *note = CMSG_FIRSTHDR(header); note; note = CMSG_NXTHDR(header, note)) {
                    if (note->cmsg_level != SOL_SOCKET) continue;
                    if (note->cmsg_type == SO_RXQ_OVFL) memcpy(&lost, CMSG_DATA(note), sizeof lost);
                    if (note->cmsg_type == SO_TIMESTAMPNS) {
                        struct timespec stamp;
                        memcpy(&stamp, CMSG_DATA(note), sizeof stamp);
                        row.wall_ns = stamp.tv_sec * INT64_C(1000000000) + stamp.tv_nsec;
                    }
                }
                require(fwrite(&row, sizeof row, 1, file) == 1 ? 0 : -1, argv[2]);
                written++;
            }
        } while (arrived == BATCH);
    }
    require(fclose(file), argv[2]);
    printf("{\"frames\": %" PRIu64 ", \"lost\": %" PRIu32 "}\n", written, lost);
    return 0;
}
