/* Loaded by tests/program/mission.rs in the place of libvulkan.so.1, which REAL_VULKAN names: when the file LOST_GPU is there,
 * the next submission removes it and answers VK_ERROR_DEVICE_LOST, as after a driver's reset. */
#include <dlfcn.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

typedef void (*function)(void);
typedef function (*lookup)(void *, const char *);
static lookup of_instance, of_device;
static int (*submit)(void *, unsigned, const void *, void *);

static int submit_or_lose(void *queue, unsigned n, const void *submits, void *fence) {
    const char *lost = getenv("LOST_GPU");
    return lost && unlink(lost) == 0 ? -4 : submit(queue, n, submits, fence);
}

static function device_function(void *device, const char *name) {
    function found = of_device(device, name);
    if (found && strcmp(name, "vkQueueSubmit") == 0) {
        submit = (int (*)(void *, unsigned, const void *, void *))found;
        return (function)submit_or_lose;
    }
    return found;
}

function vkGetInstanceProcAddr(void *instance, const char *name) {
    if (!of_instance) of_instance = (lookup)dlsym(dlopen(getenv("REAL_VULKAN"), RTLD_NOW), "vkGetInstanceProcAddr");
    function found = of_instance(instance, name);
    if (found && strcmp(name, "vkGetDeviceProcAddr") == 0) {
        of_device = (lookup)found;
        return (function)device_function;
    }
    return found;
}
