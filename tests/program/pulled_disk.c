/* Preloaded by tests/program/log.rs: once the file PULLED_FLAG is there, every call that would change what is below PULLED_DISK
 * fails with PULLED_ERRNO: 5 (EIO) for a disk that was pulled out, 30 (EROFS) for one that was made read-only. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

static int gone(const char *path) {
    const char *disk = getenv("PULLED_DISK"), *flag = getenv("PULLED_FLAG"), *code = getenv("PULLED_ERRNO");
    if (!disk || !flag || !code || strncmp(path, disk, strlen(disk)) || access(flag, F_OK)) return 0;
    errno = atoi(code);
    return 1;
}

static int gone_fd(int fd) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n <= 0) return 0;
    path[n] = 0;
    return gone(path);
}

#define REAL(type, name) ((type)dlsym(RTLD_NEXT, #name))
#define ON_FD(result, name, parameters, types, arguments) \
    result name parameters { return gone_fd(fd) ? -1 : REAL(result(*) types, name) arguments; }
#define ON_PATH(name, parameters, types, arguments) \
    int name parameters { return gone(path) ? -1 : REAL(int(*) types, name) arguments; }

ON_FD(ssize_t, write, (int fd, const void *p, size_t n), (int, const void *, size_t), (fd, p, n))
ON_FD(ssize_t, writev, (int fd, const struct iovec *v, int n), (int, const struct iovec *, int), (fd, v, n))
ON_FD(int, fsync, (int fd), (int), (fd))
ON_FD(int, fdatasync, (int fd), (int), (fd))
ON_FD(int, ftruncate, (int fd, off_t n), (int, off_t), (fd, n))
ON_FD(int, ftruncate64, (int fd, off64_t n), (int, off64_t), (fd, n))
ON_PATH(rename, (const char *path, const char *to), (const char *, const char *), (path, to))
ON_PATH(unlink, (const char *path), (const char *), (path))
ON_PATH(mkdir, (const char *path, mode_t mode), (const char *, mode_t), (path, mode))
ON_PATH(rmdir, (const char *path), (const char *), (path))

#define OPEN(name)                                                                       \
    int name(const char *path, int flags, ...) {                                         \
        va_list list;                                                                    \
        va_start(list, flags);                                                           \
        mode_t mode = flags & O_CREAT ? va_arg(list, mode_t) : 0;                        \
        va_end(list);                                                                    \
        int writes = flags & (O_CREAT | O_WRONLY | O_RDWR);                              \
        if (writes && gone(path)) return -1;                                             \
        return REAL(int (*)(const char *, int, ...), name)(path, flags, mode);           \
    }
OPEN(open)
OPEN(open64)
