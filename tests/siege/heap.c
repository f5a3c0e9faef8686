// Measures the heap of a server for soak.py. Preloaded with LD_PRELOAD, it writes the bytes that the allocator has handed
// out and not got back to the file SOAK_HEAP, as one uint64_t, SAMPLES_PER_SECOND times per second.
//
// For the negative control, it also leaks: if SOAK_STEPS names a file, an array of uint64_t in which the clients count
// their steps, it allocates LEAK_BYTES for each step and never frees them.

#include <fcntl.h>
#include <malloc.h>
#include <pthread.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#define LEAK_BYTES 1024
#define SAMPLES_PER_SECOND 10

static volatile uint64_t *heap_bytes;
static const volatile uint64_t *counts;
static size_t count_entries;

static uint64_t steps(void) {
    uint64_t sum = 0;
    for (size_t entry = 0; entry < count_entries; entry++) {
        sum += counts[entry];
    }
    return sum;
}

static void *measure(void *unused) {
    (void)unused;
    for (uint64_t leaked = 0;;) {
        for (uint64_t end = steps(); leaked < end; leaked++) {
            void *block = malloc(LEAK_BYTES);
            if (block != NULL) {
                memset(block, 1, LEAK_BYTES);
            }
        }
        // All arenas, and the large blocks that have mappings of their own.
        struct mallinfo2 info = mallinfo2();
        *heap_bytes = info.uordblks + info.hblkhd;
        usleep(1000000 / SAMPLES_PER_SECOND);
    }
    return NULL;
}

// Maps the file that an environment variable names. Returns NULL without the variable or the file.
static uint64_t *map_file(const char *variable, int flags, int protection, size_t *entries) {
    const char *path = getenv(variable);
    int file = path == NULL ? -1 : open(path, flags);
    struct stat status;
    if (file < 0 || fstat(file, &status) != 0 || status.st_size == 0) {
        return NULL;
    }
    void *memory = mmap(NULL, (size_t)status.st_size, protection, MAP_SHARED, file, 0);
    close(file);
    *entries = (size_t)status.st_size / sizeof(uint64_t);
    return memory == MAP_FAILED ? NULL : memory;
}

__attribute__((constructor)) static void start(void) {
    size_t heap_entries = 0;
    heap_bytes = map_file("SOAK_HEAP", O_RDWR, PROT_READ | PROT_WRITE, &heap_entries);
    counts = map_file("SOAK_STEPS", O_RDONLY, PROT_READ, &count_entries);
    pthread_t thread;
    if (heap_bytes != NULL) {
        pthread_create(&thread, NULL, measure, NULL);
    }
}
