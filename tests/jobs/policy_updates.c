#include "policy.h"
#include <stdio.h>
int main(int argc, char **argv) {
    static policy_guard guard;
    struct { int64_t time, now; float quat[4]; policy_readings readings; char end; } in;
    struct { float status, gain, steps; policy_targets targets; float commands[4]; } out;
    size_t size = sizeof out - (POLICY_HAS_BUMP ? 0 : sizeof out.commands);
    (void)argv;
    policy_begin(&guard, argc > 1);
    while (fread(&in, (size_t)(&in.end - (char *)&in), 1, stdin)) {
        if (in.quat[0] < 9.0f) policy_projected_gravity(in.quat, in.readings.projected_gravity);
        out.status = (float)policy_update(&guard, &in.readings, in.time, in.now, &out.targets, &out.gain);
        out.steps = (float)guard.policy.steps;
        memset(out.commands, 0, sizeof out.commands);
#if POLICY_HAS_BUMP
        if (guard.phase == POLICY_RUN) memcpy(out.commands, guard.policy.bump.command, sizeof guard.policy.bump.command);
        if (guard.phase == POLICY_RUN) out.commands[3] = guard.policy.bump.left / POLICY_BUMP_WINDOW_S;
#endif
        fwrite(&out, size, 1, stdout);
    }
    return 0;
}
