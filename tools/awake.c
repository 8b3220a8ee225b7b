// How long a process is awake: a library to be preloaded, which takes the time of the calls that wait.
//
// Where the kernel counts CPU time by sampling at its timer's ticks, as user-mode Linux does, the CPU clock of a process
// that runs for parts of a millisecond says nothing. A process of the highest priority is on the processor whenever it
// is not waiting; so what it takes is the time that passes less the time spent in these calls. AWAKE_FILE names the file
// of the numbers below. The first process that makes the file is the one that is looked at; its children are not.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <poll.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/select.h>
#include <time.h>
#include <unistd.h>

enum { START_TICKS, START_NS, WAITED_TICKS, CALLS, NOW_TICKS, NOW_NS, NUMBERS };
static volatile uint64_t *numbers;

static uint64_t read_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000 + (uint64_t)now.tv_nsec;
}

// Of the processor where it has a counter that user programs may read, since a clock may be a system call.
static uint64_t read_ticks(void) {
#if defined(__x86_64__) || defined(__i386__)
    return __builtin_ia32_rdtsc();
#else
    return read_ns();
#endif
}

__attribute__((constructor)) static void begin(void) {
    const char *path = getenv("AWAKE_FILE");
    if (path == NULL) return;
    int file = open(path, O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0600);
    if (file < 0) return;
    if (ftruncate(file, NUMBERS * sizeof(uint64_t)) == 0) {
        void *place = mmap(NULL, NUMBERS * sizeof(uint64_t), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
        if (place != MAP_FAILED) numbers = place;
    }
    close(file);
    if (numbers == NULL) return;
    numbers[START_NS] = read_ns();
    numbers[START_TICKS] = read_ticks();
}

static void add(uint64_t since) {
    uint64_t now = read_ticks();
    numbers[WAITED_TICKS] += now - since;
    if (numbers[CALLS]++ % 1024 == 0) {
        numbers[NOW_NS] = read_ns();
        numbers[NOW_TICKS] = read_ticks();
    }
}

#define WAIT(type, name, parameters, ...)                                                                             \
    type name parameters {                                                                                            \
        static type(*real) parameters;                                                                                \
        if (real == NULL) *(void **)&real = dlsym(RTLD_NEXT, #name);                                                  \
        if (numbers == NULL) return real(__VA_ARGS__);                                                                \
        uint64_t since = read_ticks();                                                                                \
        type result = real(__VA_ARGS__);                                                                              \
        add(since);                                                                                                   \
        return result;                                                                                                \
    }

WAIT(int, clock_nanosleep, (clockid_t clock, int flags, const struct timespec *due, struct timespec *left), clock, flags,
     due, left)
WAIT(int, nanosleep, (const struct timespec *due, struct timespec *left), due, left)
WAIT(int, poll, (struct pollfd * polled, nfds_t count, int timeout), polled, count, timeout)
WAIT(int, ppoll, (struct pollfd * polled, nfds_t count, const struct timespec *timeout, const sigset_t *mask), polled,
     count, timeout, mask)
WAIT(int, select, (int count, fd_set *in, fd_set *out, fd_set *other, struct timeval *timeout), count, in, out, other,
     timeout)
