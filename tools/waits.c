// Preloaded into a process: notes when it goes to wait and when it goes on (sleep, poll, select), to say how long it
// works per cycle. A process that has its processor to itself works whenever it doesn't wait; the kernel's own account
// of CPU time may move in steps of 10 ms, at the same phase of every cycle, and then says nothing.
//
// WAITS names the file, which must not exist: a child process notes nothing. It begins with two pairs int64, the
// processor's counter and CLOCK_MONOTONIC in ns, as of the start and of the end, then holds pairs: the counter before
// and after each wait of the main thread. A counter, because a clock may be a system call, which is what is measured.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <poll.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/select.h>
#include <time.h>
#include <unistd.h>

enum { MOST_WAITS = 1 << 20 };

static int64_t waits[MOST_WAITS][2];
static int64_t count;
static int file = -1;
static _Thread_local int is_main;  // set by the constructor, which the main thread runs: a system call would cost

static int64_t clocks[2][2];

static int64_t now_ns(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

static int64_t now(void) {
#if defined(__x86_64__) || defined(__i386__)
    return (int64_t)__builtin_ia32_rdtsc();
#else
    return now_ns();
#endif
}

static void read_clocks(int64_t *pair) {
    pair[1] = now_ns();
    pair[0] = now();
}

__attribute__((constructor)) static void begin(void) {
    const char *path = getenv("WAITS");
    is_main = 1;
    read_clocks(clocks[0]);
    if (path != NULL) file = open(path, O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
}

__attribute__((destructor)) static void end(void) {
    if (file < 0) return;
    read_clocks(clocks[1]);
    const size_t bytes = (size_t)count * sizeof *waits;
    if (write(file, clocks, sizeof clocks) < 0 || write(file, waits, bytes) < 0) _exit(1);
    close(file);
}

static int is_noted(void) {
    return file >= 0 && count < MOST_WAITS && is_main;
}

#define WAIT(name, parameters, arguments)                                  \
    int name parameters {                                                  \
        static int(*real) parameters;                                      \
        if (real == NULL) *(void **)&real = dlsym(RTLD_NEXT, #name);       \
        if (!is_noted()) return real arguments;                            \
        const int64_t before = now();                                      \
        const int result = real arguments;                                 \
        waits[count][0] = before;                                          \
        waits[count++][1] = now();                                         \
        return result;                                                     \
    }

WAIT(clock_nanosleep, (clockid_t clock, int flags, const struct timespec *t, struct timespec *left), (clock, flags, t, left))
WAIT(nanosleep, (const struct timespec *t, struct timespec *left), (t, left))
WAIT(poll, (struct pollfd *fds, nfds_t n, int timeout), (fds, n, timeout))
WAIT(ppoll, (struct pollfd *fds, nfds_t n, const struct timespec *t, const sigset_t *mask), (fds, n, t, mask))
WAIT(select, (int n, fd_set *in, fd_set *out, fd_set *other, struct timeval *t), (n, in, out, other, t))
