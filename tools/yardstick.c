// The shortest host: the system calls of one cycle of adacd-hil, and no computation between them.
//
// Per cycle: clock_nanosleep to a grid point, clock_gettime, send SYNC, ppoll and recvmmsg until every awaited frame
// is in, clock_gettime, sendmmsg of the commands, clock_gettime. Identifiers and frames are arguments; it knows no
// protocol. What it needs beyond these calls a 1 kHz process in any language needs as well, so its times are the limit
// of the machine. Columns of a sample, in ns:
//
//     due        the grid point, by CLOCK_MONOTONIC
//     lateness   wake-up after the grid point
//     feedback   SYNC to the last awaited frame read, by the clock after it
//     compute    that reading of the clock to the last command handed to the kernel
//     command    SYNC to the last command handed to the kernel
//     answer     the kernel's receive stamp of the last frame to the last command handed to the kernel
#define _GNU_SOURCE
#include <errno.h>
#include <getopt.h>
#include <inttypes.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <poll.h>
#include <sched.h>
#include <signal.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { COLUMNS = 6, MOST_IDS = 64, MOST_FIRST = 8, MOST_COMMANDS = 4, BATCH = 16, PRIORITY = 80, SYNC_OVERFLOW = 240 };
enum { DUE, LATENESS, FEEDBACK, COMPUTE, COMMAND, ANSWER };
static const char *const NAMES[COLUMNS] = {"due", "lateness", "feedback", "compute", "command", "answer"};
static const int64_t SECOND = 1000000000;

typedef struct {
    struct canfd_frame frame;
    size_t size;  // CAN_MTU or CANFD_MTU
} packet;

typedef struct {
    packet *packets;
    size_t count;
} sequence;

static volatile sig_atomic_t is_stopped;

static void stop(int number) {
    (void)number;
    is_stopped = 1;
}

static _Noreturn void fail(int status, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    fputs("yardstick: ", stderr);
    vfprintf(stderr, format, arguments);
    fputc('\n', stderr);
    va_end(arguments);
    exit(status);
}

static const char USAGE[] =
    "usage: yardstick -i INTERFACE -s ID -r ID... -c ID#DATA,DATA... [options]\n"
    "  -i NAME            CAN interface\n"
    "  -s ID              SYNC, hexadecimal as all identifiers\n"
    "  -r ID              awaited in every cycle; may be repeated\n"
    "  -x ID              also received; may be repeated\n"
    "  -c ID#DATA,...     command of cycle 0, 1, ..., over again; may be repeated\n"
    "  -n ID#DATA         sent before the first cycle, then 0.3 s of waiting; may be repeated\n"
    "  -z ID#DATA         sent after the last cycle; may be repeated\n"
    "  -e N:ID#DATA       sent every N cycles\n"
    "  -p MICROSECONDS    period, default 1000\n"
    "  -d SECONDS         ends after this time; default 3600; SIGINT and SIGTERM end it as well\n"
    "  -w SECONDS         of the beginning that are left out of the samples, default 0\n"
    "  -o FILE            samples: int64, 6 columns, row by row: due lateness feedback compute command answer\n";

static _Noreturn void refuse(const char *what, const char *text) {
    fprintf(stderr, "yardstick: %s: %s\n%s", what, text, USAGE);
    exit(2);
}

static double parse_number(const char *text, double low, double high) {
    char *end;
    double value = strtod(text, &end);
    if (end == text || *end != '\0' || !(value >= low && value <= high)) refuse("not a number in range", text);
    return value;
}

static canid_t parse_id(const char *text, const char *end) {
    char *parsed;
    unsigned long value = strtoul(text, &parsed, 16);
    if (parsed == text || parsed != end || value > CAN_SFF_MASK) refuse("not an 11-bit identifier", text);
    return (canid_t)value;
}

static packet parse_data(canid_t id, const char *text, size_t digits) {
    packet made = {.frame = {.can_id = id}, .size = CAN_MTU};
    if (digits % 2 || digits / 2 > CANFD_MAX_DLEN) refuse("not the data of a frame", text);
    for (size_t place = 0; place < digits / 2; place++) {
        const char byte[] = {text[2 * place], text[2 * place + 1], '\0'};
        if (strspn(byte, "0123456789abcdefABCDEF") != 2) refuse("not hexadecimal", text);
        made.frame.data[place] = (uint8_t)strtoul(byte, NULL, 16);
    }
    made.frame.len = (uint8_t)(digits / 2);
    if (made.frame.len > CAN_MAX_DLEN) {
        made.frame.flags = CANFD_BRS;
        made.size = CANFD_MTU;
    }
    return made;
}

static sequence parse_frames(const char *text) {
    const char *mark = strchr(text, '#');
    if (mark == NULL) refuse("not ID#DATA", text);
    canid_t id = parse_id(text, mark);
    sequence made = {NULL, 0};
    for (const char *at = mark + 1;; at++) {
        size_t digits = strcspn(at, ",");
        made.packets = realloc(made.packets, (made.count + 1) * sizeof(packet));
        if (made.packets == NULL) fail(1, "no memory");
        made.packets[made.count++] = parse_data(id, at, digits);
        at += digits;
        if (*at == '\0') return made;
    }
}

static int64_t read_clock(clockid_t clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec * SECOND + now.tv_nsec;
}

// CLOCK_REALTIME minus CLOCK_MONOTONIC, from the closest of some pairs of readings.
static int64_t wall_offset(void) {
    int64_t offset = 0, closest = INT64_MAX;
    for (int trial = 0; trial < 10; trial++) {
        int64_t before = read_clock(CLOCK_MONOTONIC), wall = read_clock(CLOCK_REALTIME);
        int64_t after = read_clock(CLOCK_MONOTONIC);
        if (after - before < closest) {
            closest = after - before;
            offset = wall - before - (after - before) / 2;
        }
    }
    return offset;
}

static void wait_until(int64_t t) {
    struct timespec due = {.tv_sec = t / SECOND, .tv_nsec = t % SECOND};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL) == EINTR && !is_stopped) {}
}

static void set_option(int bus, int level, int name, const void *value, socklen_t size, const char *what) {
    if (setsockopt(bus, level, name, value, size) != 0) fail(1, "%s: %s", what, strerror(errno));
}

static int open_bus(const char *interface, const canid_t *ids, size_t count, int is_fd) {
    struct can_filter filters[MOST_IDS];
    const int yes = 1;
    int bus = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    if (bus < 0) fail(5, "this kernel has no SocketCAN: %s", strerror(errno));
    for (size_t place = 0; place < count; place++)
        filters[place] = (struct can_filter){ids[place], CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG};
    set_option(bus, SOL_CAN_RAW, CAN_RAW_FILTER, filters, (socklen_t)(count * sizeof *filters), "filter");
    set_option(bus, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &is_fd, sizeof is_fd, "CAN FD");
    set_option(bus, SOL_SOCKET, SO_TIMESTAMPNS, &yes, sizeof yes, "receive stamps");
    set_option(bus, SOL_SOCKET, SO_RXQ_OVFL, &yes, sizeof yes, "count of drops");
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(interface)};
    if (address.can_ifindex == 0 || bind(bus, (struct sockaddr *)&address, sizeof address) != 0)
        fail(5, "CAN interface %s: %s", interface, strerror(errno));
    return bus;
}

static void send_each(int bus, const sequence *frames, size_t count) {
    for (size_t place = 0; place < count; place++) {
        const packet *first = frames[place].packets;
        if (send(bus, &first->frame, first->size, 0) < 0) fail(1, "sending: %s", strerror(errno));
        wait_until(read_clock(CLOCK_MONOTONIC) + 3 * SECOND / 10);
    }
}

static int compare(const void *left, const void *right) {
    int64_t a = *(const int64_t *)left, b = *(const int64_t *)right;
    return (a > b) - (a < b);
}

static void print_percentiles(int64_t (*samples)[COLUMNS], size_t count) {
    int64_t *values = malloc((count + 1) * sizeof *values);
    if (values == NULL) fail(1, "no memory");
    for (int column = LATENESS; column < COLUMNS; column++) {
        for (size_t row = 0; row < count; row++) values[row] = samples[row][column];
        qsort(values, count, sizeof *values, compare);
        const double shares[] = {0.5, 0.99, 0.999, 1.0};
        printf(", \"%s_ns\": [", NAMES[column]);
        for (int share = 0; share < 4 && count > 0; share++)
            printf("%s%" PRId64, share ? ", " : "", values[(size_t)(shares[share] * (double)(count - 1) + 0.5)]);
        printf("]");
    }
    free(values);
}

int main(int argc, char **argv) {
    const char *interface = NULL, *path = NULL;
    canid_t sync_id = 0, ids[MOST_IDS];
    size_t awaited = 0, received = 0, befores = 0, afters = 0, commands = 0;
    canid_t extra[MOST_IDS];
    size_t extras = 0;
    sequence before[MOST_FIRST], after[MOST_FIRST], command[MOST_COMMANDS], every = {NULL, 0};
    int64_t every_cycles = 0;
    double period_us = 1000.0, seconds = 3600.0, warm_up_s = 0.0;
    bool has_sync = false;
    for (int option; (option = getopt(argc, argv, "i:s:r:x:c:n:z:e:p:d:w:o:")) != -1;) {
        char *colon;
        switch (option) {
        case 'i': interface = optarg; break;
        case 's': sync_id = parse_id(optarg, optarg + strlen(optarg)); has_sync = true; break;
        case 'r':
            if (awaited == MOST_IDS / 2) refuse("too many", optarg);
            ids[awaited++] = parse_id(optarg, optarg + strlen(optarg));
            break;
        case 'x':
            if (extras == MOST_IDS / 2) refuse("too many", optarg);
            extra[extras++] = parse_id(optarg, optarg + strlen(optarg));
            break;
        case 'c':
            if (commands == MOST_COMMANDS) refuse("too many", optarg);
            command[commands++] = parse_frames(optarg);
            break;
        case 'n':
            if (befores == MOST_FIRST) refuse("too many", optarg);
            before[befores++] = parse_frames(optarg);
            break;
        case 'z':
            if (afters == MOST_FIRST) refuse("too many", optarg);
            after[afters++] = parse_frames(optarg);
            break;
        case 'e':
            every_cycles = strtol(optarg, &colon, 10);
            if (*colon != ':' || every_cycles < 1) refuse("not N:ID#DATA", optarg);
            every = parse_frames(colon + 1);
            break;
        case 'p': period_us = parse_number(optarg, 100.0, 1e6); break;
        case 'd': seconds = parse_number(optarg, 0.0, 1e6); break;
        case 'w': warm_up_s = parse_number(optarg, 0.0, 1e6); break;
        case 'o': path = optarg; break;
        default: fputs(USAGE, stderr); return 2;
        }
    }
    if (optind != argc) refuse("not an option", argv[optind]);
    if (interface == NULL || !has_sync || awaited == 0 || commands == 0) refuse("missing", "-i, -s, -r or -c");
    int is_fd = 0;
    for (size_t place = 0; place < commands; place++) {
        if (command[place].count != command[0].count) refuse("commands", "as many for each identifier");
        is_fd |= command[place].packets[0].size == CANFD_MTU;
    }
    received = awaited;
    for (size_t place = 0; place < extras; place++) ids[received++] = extra[place];

    const int64_t period = (int64_t)(period_us * 1000.0), patience = period * 7 / 10;
    const size_t room = (size_t)(seconds * 1e6 / period_us) + 1;
    int64_t(*samples)[COLUMNS] = calloc(room, sizeof *samples);
    if (samples == NULL) fail(1, "no memory for %zu samples", room);
    int bus = open_bus(interface, ids, received, is_fd);
    const char *scheduler = "SCHED_FIFO 80";
    if (sched_setscheduler(0, SCHED_FIFO | SCHED_RESET_ON_FORK, &(struct sched_param){.sched_priority = PRIORITY}) != 0)
        scheduler = "SCHED_OTHER";
    bool is_locked = mlockall(MCL_CURRENT | MCL_FUTURE) == 0;
    signal(SIGINT, stop);
    signal(SIGTERM, stop);

    struct canfd_frame read[BATCH];
    struct iovec places[BATCH], outgoing[MOST_COMMANDS];
    struct mmsghdr incoming[BATCH], answers[MOST_COMMANDS];
    union {
        char bytes[CMSG_SPACE(sizeof(struct timespec)) + CMSG_SPACE(sizeof(uint32_t))];
        struct cmsghdr aligned;
    } control[BATCH];
    memset(incoming, 0, sizeof incoming);
    memset(answers, 0, sizeof answers);
    for (int place = 0; place < BATCH; place++) {
        places[place] = (struct iovec){&read[place], sizeof read[place]};
        incoming[place].msg_hdr = (struct msghdr){.msg_iov = &places[place], .msg_iovlen = 1, .msg_control = &control[place]};
    }
    for (size_t place = 0; place < commands; place++)
        answers[place].msg_hdr = (struct msghdr){.msg_iov = &outgoing[place], .msg_iovlen = 1};

    send_each(bus, before, befores);
    const int64_t offset = wall_offset();
    const uint64_t all = ((uint64_t)1 << awaited) - 1;
    int64_t overruns = 0, missing = 0, unsent = 0, cycles = 0, cycle = -1;
    uint32_t lost = 0;
    size_t count = 0;
    struct can_frame sync = {.can_id = sync_id, .len = 1};
    fputs("running\n", stderr);
    const int64_t start = (read_clock(CLOCK_MONOTONIC) + period - 1) / period * period;
    const int64_t first_sample = start + (int64_t)(warm_up_s * 1e9), end = start + (int64_t)(seconds * 1e9);
    const int64_t busy_before = read_clock(CLOCK_PROCESS_CPUTIME_ID);
    struct rusage usage_before, usage;
    getrusage(RUSAGE_SELF, &usage_before);

    while (!is_stopped) {
        int64_t due = start + ++cycle * period;
        wait_until(due);
        const int64_t now = read_clock(CLOCK_MONOTONIC);
        const int64_t skipped = (now - due) / period;
        if (skipped > 0) {
            overruns += skipped;
            cycle += skipped;
            due += skipped * period;
        }
        if (due >= end || count == room) break;
        sync.data[0] = (uint8_t)(cycles % SYNC_OVERFLOW + 1);
        if (send(bus, &sync, CAN_MTU, 0) < 0) unsent++;

        uint64_t seen = 0;
        int64_t stamp = now;
        while (seen != all && stamp - now < patience) {
            const int64_t left = patience - (stamp - now);
            struct timespec timeout = {.tv_sec = left / SECOND, .tv_nsec = left % SECOND};
            struct pollfd poll = {.fd = bus, .events = POLLIN};
            if (ppoll(&poll, 1, &timeout, NULL) <= 0) break;
            for (int place = 0; place < BATCH; place++) incoming[place].msg_hdr.msg_controllen = sizeof control[place];
            const int arrived = recvmmsg(bus, incoming, BATCH, MSG_DONTWAIT, NULL);
            for (int place = 0; place < arrived; place++) {
                struct msghdr *header = &incoming[place].msg_hdr;
                for (struct cmsghdr *note = CMSG_FIRSTHDR(header); note; note = CMSG_NXTHDR(header, note)) {
                    if (note->cmsg_level != SOL_SOCKET) continue;
                    if (note->cmsg_type == SO_RXQ_OVFL) memcpy(&lost, CMSG_DATA(note), sizeof lost);
                    if (note->cmsg_type == SO_TIMESTAMPNS) {
                        struct timespec wall;
                        memcpy(&wall, CMSG_DATA(note), sizeof wall);
                        stamp = wall.tv_sec * SECOND + wall.tv_nsec - offset;
                    }
                }
                for (size_t id = 0; id < awaited; id++)
                    if (read[place].can_id == ids[id]) seen |= (uint64_t)1 << id;
            }
        }
        const int64_t in = read_clock(CLOCK_MONOTONIC);
        for (size_t place = 0; place < commands; place++) {
            packet *next = &command[place].packets[(size_t)cycles % command[place].count];
            outgoing[place] = (struct iovec){&next->frame, next->size};
        }
        const int sent = sendmmsg(bus, answers, (unsigned int)commands, 0);
        const int64_t out = read_clock(CLOCK_MONOTONIC);

        cycles++;
        if (sent != (int)commands) unsent++;
        if (seen != all) missing++;
        if (every_cycles > 0 && cycle % every_cycles == 0 && send(bus, &every.packets[0].frame, every.packets[0].size, 0) < 0)
            unsent++;
        if (now >= first_sample) {
            int64_t *sample = samples[count++];
            sample[DUE] = due;
            sample[LATENESS] = now - due;
            sample[FEEDBACK] = in - now;
            sample[COMPUTE] = out - in;
            sample[COMMAND] = out - now;
            sample[ANSWER] = out - stamp;
        }
    }

    const int64_t busy = read_clock(CLOCK_PROCESS_CPUTIME_ID) - busy_before;
    getrusage(RUSAGE_SELF, &usage);
    const double used_us = (double)(usage.ru_utime.tv_sec - usage_before.ru_utime.tv_sec + usage.ru_stime.tv_sec -
                                    usage_before.ru_stime.tv_sec) * 1e6 +
                           (double)(usage.ru_utime.tv_usec - usage_before.ru_utime.tv_usec + usage.ru_stime.tv_usec -
                                    usage_before.ru_stime.tv_usec);
    const double each = cycles > 0 ? (double)cycles : 1.0;
    is_stopped = 0;
    send_each(bus, after, afters);
    printf("{\"name\": \"yardstick\", \"scheduler\": \"%s\", \"is_locked\": %s, \"period_us\": %.0f", scheduler,
           is_locked ? "true" : "false", period_us);
    printf(", \"cycles\": %" PRId64 ", \"samples\": %zu, \"overruns\": %" PRId64, cycles, count, overruns);
    printf(", \"cycles_incomplete\": %" PRId64 ", \"cycles_unsent\": %" PRId64 ", \"frames_lost\": %" PRIu32, missing, unsent, lost);
    printf(", \"cpu_us\": %.3f, \"cpu_rusage_us\": %.3f", (double)busy / 1000.0 / each, used_us / each);
    printf(", \"wall_clock_drift_ns\": %" PRId64, wall_offset() - offset);
    print_percentiles(samples, count);
    puts("}");
    if (path != NULL) {
        FILE *file = fopen(path, "wb");
        if (file == NULL || fwrite(samples, sizeof *samples, count, file) != count || fclose(file) != 0)
            fail(1, "%s: %s", path, strerror(errno));
    }
    return 0;
}
