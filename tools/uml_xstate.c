// Preloaded into user-mode Linux, whose buffer for a process's registers ends before AMX's. The host wants its own
// layout whole when they are set (EFAULT), though it gives less when they are read. What the buffer lacks is filled up
// with what the process has.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

enum { ROOM = 1 << 16 };

typedef long Ptrace(enum __ptrace_request, ...);

static Ptrace *next;
static unsigned char whole[ROOM] __attribute__((aligned(64)));  // the kernel has little stack, and one thread

__attribute__((constructor)) static void find_next(void) { next = (Ptrace *)dlsym(RTLD_NEXT, "ptrace"); }

long ptrace(enum __ptrace_request request, ...) {
    va_list rest;
    va_start(rest, request);
    pid_t pid = va_arg(rest, pid_t);
    void *address = va_arg(rest, void *);
    void *data = va_arg(rest, void *);
    va_end(rest);
    if (request == PTRACE_SETREGSET && (uintptr_t)address == NT_X86_XSTATE) {
        const struct iovec *given = data;
        struct iovec all = {whole, sizeof whole};
        if (next(PTRACE_GETREGSET, pid, address, &all) == 0 && given->iov_len < all.iov_len) {
            memcpy(whole, given->iov_base, given->iov_len);
            return next(PTRACE_SETREGSET, pid, address, &all);
        }
    }
    return next(request, pid, address, data);
}
