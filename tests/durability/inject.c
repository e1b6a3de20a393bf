/* Faults for tests: calls of the C library that fail where a rule says so. Loaded into the service with LD_PRELOAD.
 *
 * The file that CAIRN_INJECT names holds the rules and is read at every call, so that a test changes them while the service runs. A line
 * is "CALL ACTION SKIP PATH": calls of that kind on files whose path contains PATH, after SKIP of them were let pass.
 *   CALL    write, sync, open, rename
 *   ACTION  enospc, eio: the call fails with this error; short: a write writes half; abort, loop: so does the process; gorge: the
 *           process takes ever more memory
 * Every call that a rule strikes adds a byte to the file that is named like the rules and ".struck".
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <unistd.h>

enum { PASS, FAIL, HALF };
static atomic_long passed;
static atomic_ulong current;

static void note(const char *control) {
    char path[4096];
    if (snprintf(path, sizeof path, "%s.struck", control) >= (int)sizeof path) return;
    int fd = syscall(SYS_openat, AT_FDCWD, path, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0644);
    if (fd < 0) return;
    syscall(SYS_write, fd, ".", 1);
    syscall(SYS_close, fd);
}

static void gorge(void) {
    const size_t piece = 16 << 20;
    for (;;) {
        void *more = malloc(piece);
        if (!more) abort();
        memset(more, 1, piece);
        usleep(20000);
    }
}

static int judge(const char *call, const char *path) {
    const char *control = getenv("CAIRN_INJECT");
    char text[4096];
    if (!control) return PASS;
    int fd = syscall(SYS_openat, AT_FDCWD, control, O_RDONLY | O_CLOEXEC);
    if (fd < 0) return PASS;
    long n = syscall(SYS_read, fd, text, sizeof text - 1);
    syscall(SYS_close, fd);
    if (n <= 0) return PASS;
    text[n] = 0;
    unsigned long hash = 5381;
    for (long i = 0; i < n; i++) hash = hash * 33 + (unsigned char)text[i];
    if (atomic_exchange(&current, hash) != hash) atomic_store(&passed, 0);
    char *rest = text, *line;
    while ((line = strsep(&rest, "\n"))) {
        char kind[16], action[16], part[1024];
        long skip;
        if (sscanf(line, "%15s %15s %ld %1023s", kind, action, &skip, part) != 4) continue;
        if (strcmp(kind, call) || !strstr(path, part)) continue;
        if (atomic_fetch_add(&passed, 1) < skip) continue;
        note(control);
        if (!strcmp(action, "short")) return HALF;
        if (!strcmp(action, "abort")) abort();
        if (!strcmp(action, "loop")) for (;;) usleep(1000);
        if (!strcmp(action, "gorge")) gorge();
        errno = !strcmp(action, "enospc") ? ENOSPC : EIO;
        return FAIL;
    }
    return PASS;
}

static int judge_fd(const char *call, int fd) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    long n = readlink(link, path, sizeof path - 1);
    if (n <= 0) return PASS;
    path[n] = 0;
    return judge(call, path);
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define HALVED(n) ((n) > 1 ? (n) / 2 : (n))

ssize_t write(int fd, const void *bytes, size_t n) {
    int verdict = judge_fd("write", fd);
    return verdict == FAIL ? -1 : REAL(write)(fd, bytes, verdict == HALF ? HALVED(n) : n);
}
ssize_t pwrite(int fd, const void *bytes, size_t n, off_t at) {
    int verdict = judge_fd("write", fd);
    return verdict == FAIL ? -1 : REAL(pwrite)(fd, bytes, verdict == HALF ? HALVED(n) : n, at);
}
ssize_t pwrite64(int fd, const void *bytes, size_t n, off64_t at) {
    int verdict = judge_fd("write", fd);
    return verdict == FAIL ? -1 : REAL(pwrite64)(fd, bytes, verdict == HALF ? HALVED(n) : n, at);
}
int ftruncate(int fd, off_t length) {
    return judge_fd("write", fd) == FAIL ? -1 : REAL(ftruncate)(fd, length);
}
int ftruncate64(int fd, off64_t length) {
    return judge_fd("write", fd) == FAIL ? -1 : REAL(ftruncate64)(fd, length);
}
int fsync(int fd) {
    return judge_fd("sync", fd) == FAIL ? -1 : REAL(fsync)(fd);
}
int fdatasync(int fd) {
    return judge_fd("sync", fd) == FAIL ? -1 : REAL(fdatasync)(fd);
}
int rename(const char *from, const char *to) {
    return judge("rename", to) == FAIL ? -1 : REAL(rename)(from, to);
}
int open(const char *path, int flags, ...) {
    va_list rest;
    va_start(rest, flags);
    mode_t mode = va_arg(rest, mode_t);
    va_end(rest);
    return judge("open", path) == FAIL ? -1 : REAL(open)(path, flags, mode);
}
int open64(const char *path, int flags, ...) {
    va_list rest;
    va_start(rest, flags);
    mode_t mode = va_arg(rest, mode_t);
    va_end(rest);
    return judge("open", path) == FAIL ? -1 : REAL(open64)(path, flags, mode);
}
