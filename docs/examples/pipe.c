/* From C: the filter as a process of its own, between two pipes.

       cc -o pipe pipe.c
       ./pipe "edgefilter run --input - --output - --quiet --profile robot.npz" < stereo.raw > human.raw

   stereo.raw is 16-bit little-endian at 16 kHz, microphone and reference in turn; human.raw is mono, as many samples.
   In a robot, read_audio is the driver's capture call and use_audio the recogniser's. POSIX, no library. */

#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/types.h>
#include <sys/wait.h>
#include <unistd.h>

#define BLOCK 1280 /* bytes: 20 ms of both channels */

static ssize_t read_audio(char *block) { return read(0, block, BLOCK); }

static void use_audio(const char *block, ssize_t size)
{
    while (size > 0) {
        ssize_t done = write(1, block, (size_t)size);
        if (done <= 0)
            exit(1);
        block += done;
        size -= done;
    }
}

/* Starts the filter; what is written to *to it hears, what it says is read from *from. */
static pid_t start(const char *command, int *to, int *from)
{
    int in[2], out[2];
    pid_t child;
    if (pipe(in) || pipe(out) || (child = fork()) < 0) {
        perror("pipe");
        exit(1);
    }
    if (child == 0) {
        dup2(in[0], 0);
        dup2(out[1], 1);
        close(in[0]), close(in[1]), close(out[0]), close(out[1]);
        execl("/bin/sh", "sh", "-c", command, (char *)0);
        _exit(127);
    }
    close(in[0]), close(out[1]);
    *to = in[1], *from = out[0];
    return child;
}

int main(int argc, char **argv)
{
    char block[BLOCK], human[1 << 16];
    int to, from, status, speaking = 1;
    ssize_t size = 0, sent = 0, got;
    pid_t child;
    if (argc != 2) {
        fprintf(stderr, "usage: pipe \"edgefilter run --input - --output - --quiet\"\n");
        return 2;
    }
    signal(SIGPIPE, SIG_IGN); /* a filter that has ended is seen by what write returns */
    child = start(argv[1], &to, &from);
    for (;;) { /* write only when the filter reads, read whenever it has something: neither side waits for the other */
        struct pollfd ends[2] = {{from, POLLIN, 0}, {speaking ? to : -1, POLLOUT, 0}};
        poll(ends, 2, -1);
        if (ends[0].revents) {
            if ((got = read(from, human, sizeof human)) <= 0)
                break;
            use_audio(human, got);
        }
        if (ends[1].revents) {
            if (sent == size)
                size = read_audio(block), sent = 0;
            got = size > 0 ? write(to, block + sent, (size_t)(size - sent)) : 0;
            if (got <= 0)
                close(to), speaking = 0; /* the end: the filter gives the rest */
            else
                sent += got;
        }
    }
    waitpid(child, &status, 0);
    return WIFEXITED(status) ? WEXITSTATUS(status) : 1;
}
