/* The plainest way to take an epoch's frames from a socket: one recv for each.
 *
 *   recv EPOCHS FRAMES
 *
 * Each epoch FRAMES frames of 72 bytes (struct canfd_frame, 16 bytes of data) are put into a socket, which is not timed, and
 * taken out again. Prints the nanoseconds that taking took, of all epochs together, and the sum of the last bytes of data. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <time.h>

struct frame {
    uint32_t id;
    uint8_t len, flags, reserved[2], data[64];
};

static uint64_t now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)t.tv_sec * 1000000000u + (uint64_t)t.tv_nsec;
}

int main(int argc, char **argv)
{
    int ends[2], size = 1 << 20;
    uint64_t took = 0, sum = 0;
    if (argc != 3 || socketpair(AF_UNIX, SOCK_SEQPACKET, 0, ends) != 0)
        return 2;
    setsockopt(ends[0], SOL_SOCKET, SO_SNDBUFFORCE, &size, sizeof size);
    for (long epoch = atol(argv[1]); epoch > 0; epoch--) {
        int frames = atoi(argv[2]);
        struct frame frame = {.len = 16, .flags = 1};
        for (int n = 1; n <= frames; n++) {
            frame.id = 0x200 + n;
            frame.data[15] = (uint8_t)n;
            if (send(ends[0], &frame, sizeof frame, MSG_DONTWAIT) != sizeof frame)
                return 3;
        }
        uint64_t began = now();
        for (int n = 0; n < frames; n++) {
            if (recv(ends[1], &frame, sizeof frame, 0) != sizeof frame || frame.len > 64)
                return 4;
            sum += frame.data[15];
        }
        took += now() - began;
    }
    printf("%llu %llu\n", (unsigned long long)took, (unsigned long long)sum);
    return 0;
}
