/* The part of policy.h that is the same for all policies; c_header.py writes the constants. Copied into policy.h. */
enum { POLICY_BOUNDS, POLICY_UNIT_VECTOR, POLICY_COMMAND, POLICY_ENCODER };
enum { POLICY_REST, POLICY_LIFT, POLICY_RUN, POLICY_STOP };
enum { POLICY_FOLLOW, POLICY_BACK, POLICY_RUN_UP, POLICY_OVER }; /* after a bump */
enum { POLICY_MOST_STEPS = 10000 };
#define POLICY_TURN 6.2831853071795865f
typedef char policy_readings_have_no_padding[sizeof(policy_readings) == POLICY_NUMBERS * sizeof(float) ? 1 : -1];

typedef struct {
    policy_state policy;
    int jumps_after_bump;        /* 0 or 1; the policy gets the user's commands while it is 0 */
    policy_targets sent, before; /* before: the outputs at the start of the phase */
    float sent_gain, before_gain;
    float last[POLICY_NUMBERS];  /* the last good readings, in the order of policy_readings */
    float turns[POLICY_JOINTS];  /* added to the angles of the encoders */
    int held[POLICY_KINDS];      /* consecutive steps with a bad reading */
    int gap[POLICY_KINDS];       /* steps since the last good reading; -1: there was none */
    int phase, reason, phase_steps, calm, tilted, called;
    int64_t now_us;
} policy_guard;

/* Start the operation of policy_update: with the start-up procedure, or with the policy at once. */
static inline void policy_begin(policy_guard *g, int startup) {
    int i;
    memset(g, 0, sizeof *g);
    g->phase = startup ? POLICY_REST : POLICY_RUN;
    g->reason = POLICY_STOPPED;
    g->jumps_after_bump = POLICY_BUMP_ON;
    for (i = 0; i < POLICY_KINDS; i++) g->gap[i] = -1;
    for (i = 0; i < POLICY_JOINTS; i++) g->sent.position[i] = policy_default_joint_pos[i];
    g->sent_gain = startup ? 0.0f : 1.0f;
    g->before = g->sent;
    g->before_gain = g->sent_gain;
}

static inline int policy_added(int count, int steps) {
    return count + steps < POLICY_MOST_STEPS ? count + steps : POLICY_MOST_STEPS;
}

/* Check reading k, which was taken some steps after the previous one, and store its value unless it is bad. */
static inline void policy_accept(policy_guard *g, const float *values, int k, int steps, int stale) {
    int start = policy_rule[k][0], width = policy_rule[k][1], check = policy_rule[k][2], i, jumped = 0;
    int good = !stale && policy_finite(values + start, (size_t)width * sizeof(float));
    float x[POLICY_NUMBERS], wraps[POLICY_NUMBERS], length = 0.0f, *last = g->last + start;
    if (g->gap[k] >= 0) g->gap[k] = policy_added(g->gap[k], steps);
    memcpy(x, values + start, (size_t)width * sizeof(float));
    if (good && check == POLICY_UNIT_VECTOR) {
        for (i = 0; i < width; i++) length += x[i] * x[i];
        length = sqrtf(length);
        good = length >= policy_norm[2 * k] && length <= policy_norm[2 * k + 1];
        for (i = 0; good && fabsf(length - 1.0f) > 1e-6f && i < width; i++) x[i] /= length;
    }
    for (i = 0; good && i < width; i++) {
        float most = policy_max_jump[start + i] * (float)g->gap[k]; /* A value that persists becomes good. */
        wraps[i] = 0.0f;
        if (check == POLICY_COMMAND) x[i] = policy_clip(x[i], policy_low[start + i], policy_high[start + i]);
        if (check == POLICY_ENCODER) {
            x[i] += POLICY_TURN * g->turns[i];
            most = most < POLICY_TURN / 2.0f ? most : POLICY_TURN / 2.0f;
            /* An encoder's angle that jumps by about a whole turn has wrapped around. */
            if (g->gap[k] >= 0 && fabsf(x[i] - last[i]) > most)
                wraps[i] = floorf((x[i] - last[i]) / POLICY_TURN + 0.5f);
            x[i] -= POLICY_TURN * wraps[i];
        }
        if (g->gap[k] >= 0 && fabsf(x[i] - last[i]) > most) jumped = 1;
        if (x[i] < policy_low[start + i] || x[i] > policy_high[start + i]) good = 0;
    }
    g->held[k] = good && !jumped ? 0 : policy_added(g->held[k], steps);
    if (good && !jumped) {
        memcpy(last, x, (size_t)width * sizeof(float));
        for (i = 0; check == POLICY_ENCODER && i < width; i++) g->turns[i] -= wraps[i];
        g->gap[k] = 0;
    } else if (check == POLICY_COMMAND && g->held[k] > POLICY_HOLD_STEPS) {
        memset(last, 0, (size_t)width * sizeof(float));
    }
}

/* Whether the absolute values of all readings are at most their bounds. */
static inline int policy_below(const policy_guard *g, const float *bounds) {
    int k, i;
    for (k = 0; k < POLICY_KINDS; k++)
        for (i = 0; i < policy_rule[k][1]; i++)
            if (fabsf(g->last[policy_rule[k][0] + i]) > bounds[k]) return 0;
    return 1;
}

static inline void policy_enter(policy_guard *g, int phase, int reason) {
    g->phase = phase;
    g->reason = reason;
    g->before = g->sent;
    g->before_gain = g->sent_gain;
    g->phase_steps = 1;
    g->calm = 0;
    if (phase == POLICY_RUN) policy_reset(&g->policy);
}

#if POLICY_HAS_BUMP
static inline float policy_bump_wanted(const policy_state *s, float asked) {
    float run_up = asked > 0.0f ? POLICY_BUMP_RUN_UP : asked < 0.0f ? -(POLICY_BUMP_RUN_UP) : 0.0f;
    return s->bump.phase == POLICY_FOLLOW ? asked : s->bump.phase == POLICY_BACK ? -run_up : run_up;
}

/* Replace the user's commands among the readings: drive back from a step that stopped the wheels, run up, and jump. */
static inline void policy_jump_after_bump(policy_state *s, int on, float *readings, int steps) {
    float *velocity = readings + POLICY_BUMP_VELOCITY, *jump = readings + POLICY_BUMP_JUMP, *command = s->bump.command;
    float asked = velocity[0], dt = POLICY_BUMP_DT * (float)steps, rolled = 0.0f, way, most;
    int i, bumped;
    if (!on) memset(&s->bump, 0, sizeof s->bump); /* If it is switched on, it continues from the present command. */
    for (i = 0; i < 3; i++) {
        most = policy_bump_change[i] * (float)steps;
        command[i] = on ? command[i] + policy_clip(velocity[i] - command[i], -most, most) : velocity[i];
    }
    if (!on) { s->bump.speed = asked; return; }
    if (s->steps) {
        for (i = 0; i < POLICY_BUMP_WHEELS; i++)
            rolled += policy_bump_sign[i] * readings[POLICY_BUMP_SPEEDS + policy_bump_column[i]];
        rolled = rolled / (float)POLICY_BUMP_WHEELS * POLICY_BUMP_RADIUS;
        way = asked > 0.0f ? 1.0f : asked < 0.0f ? -1.0f : 0.0f;
        s->bump.left = s->bump.left > dt ? s->bump.left - dt : 0.0f;
        if (way != s->bump.way || (s->bump.phase == POLICY_OVER && s->bump.left <= 0.0f)) s->bump.phase = POLICY_FOLLOW;
        s->bump.way = way, s->bump.ahead -= way * rolled * dt;
        /* Wheels that follow a changing command, or that are in the air, are slow, too. */
        i = fabsf(policy_bump_wanted(s, asked) - s->bump.speed) < 1e-6f && s->bump.left <= 0.0f && fabsf(way) > 0.0f;
        s->bump.waited = i ? s->bump.waited + dt : 0.0f;
        rolled *= s->bump.speed > 0.0f ? 1.0f : s->bump.speed < 0.0f ? -1.0f : 0.0f;
        i = rolled < POLICY_BUMP_STOPPED_SHARE * fabsf(s->bump.speed) && s->bump.waited > POLICY_BUMP_WAIT_S;
        s->bump.slow = i ? s->bump.slow + dt : 0.0f;
        bumped = s->bump.slow >= POLICY_BUMP_STOPPED_S;
        if (bumped) s->bump.waited = 0.0f;
        i = bumped || s->bump.ahead >= POLICY_BUMP_BACK; /* or something is behind the robot */
        if (s->bump.phase == POLICY_BACK && i) s->bump.phase = POLICY_RUN_UP;
        else if (bumped) s->bump.phase = POLICY_BACK, s->bump.ahead = 0.0f;
        i = s->bump.phase == POLICY_RUN_UP && s->bump.left <= 0.0f;
        if (i && s->bump.ahead <= POLICY_BUMP_BEFORE_S * POLICY_BUMP_RUN_UP) {
            s->bump.phase = POLICY_OVER;
            s->bump.left = POLICY_BUMP_WINDOW_S;
        }
        most = policy_bump_change[0] * (float)steps;
        s->bump.speed += policy_clip(policy_bump_wanted(s, asked) - s->bump.speed, -most, most);
        command[0] = s->bump.speed;
        if (s->bump.phase != POLICY_FOLLOW) command[2] = 0.0f; /* straight back, and straight to the step */
    }
    if (jump[0] > 0.0f && s->bump.left <= 0.0f) s->bump.left = POLICY_BUMP_WINDOW_S;
    memcpy(velocity, command, sizeof s->bump.command);
    for (i = 1; i < POLICY_BUMP_NUMBERS; i++) jump[i] = s->bump.left > 0.0f ? POLICY_BUMP_HEIGHT : 0.0f;
    jump[0] = s->bump.left / POLICY_BUMP_WINDOW_S;
}
#endif

static inline float policy_ramped(const policy_guard *g, float from, float to, int steps) {
    return from + (float)(g->phase_steps < steps ? g->phase_steps : steps) / (float)steps * (to - from);
}

/* The outputs of the phases in which the policy does not run; joints without limits stay where they are. */
static inline void policy_at_rest(policy_guard *g) {
    const float *measured = g->last + policy_rule[POLICY_ENCODERS][0];
    int i, blind = g->gap[POLICY_ENCODERS] < 0, lifts = g->phase == POLICY_LIFT;
    int steps = lifts ? POLICY_LIFT_STEPS : POLICY_RAMP_STEPS;
    float safe = g->before_gain < POLICY_STOP_GAIN ? g->before_gain : POLICY_STOP_GAIN;
    for (i = 0; i < POLICY_JOINTS; i++) {
        float low = policy_position_low[i], high = policy_position_high[i], position;
        float pose = lifts ? policy_default_joint_pos[i] : policy_safe_position[i];
        if (blind) position = policy_default_joint_pos[i];
        else if (low <= -1e30f && high >= 1e30f) position = measured[i] - POLICY_TURN * g->turns[i];
        else if (g->phase == POLICY_REST) position = measured[i];
        else position = policy_ramped(g, g->before.position[i], pose, steps);
        g->sent.position[i] = policy_clip(position, low, high);
        g->sent.velocity[i] = policy_ramped(g, g->before.velocity[i], 0.0f, steps);
        g->sent.effort[i] = policy_ramped(g, g->before.effort[i], 0.0f, steps);
    }
    g->sent_gain = policy_ramped(g, g->before_gain, lifts ? 1.0f : safe, steps);
    if (blind || g->phase == POLICY_REST) {
        memset(g->sent.velocity, 0, sizeof g->sent.velocity);
        memset(g->sent.effort, 0, sizeof g->sent.effort);
        g->sent_gain = 0.0f;
    }
}

/* The outputs of the policy; 0 if they are not finite. */
static inline int policy_run(policy_guard *g, int steps) {
    policy_readings readings;
    policy_targets targets;
    float values[POLICY_NUMBERS];
    int i;
    memcpy(values, g->last, sizeof values);
#if POLICY_HAS_BUMP
    policy_jump_after_bump(&g->policy, g->jumps_after_bump, values, steps);
#endif
    memcpy(&readings, values, sizeof readings);
    if (g->policy.steps) g->policy.steps += steps - 1; /* Terms such as gait_phase count the missed steps. */
    if (policy_step(&g->policy, &readings, &targets)) return 0;
    if (!policy_finite(g->policy.action, sizeof g->policy.action) || !policy_finite(&targets, sizeof targets)) return 0;
    g->sent = targets;
    g->sent_gain = policy_ramped(g, g->before_gain, 1.0f, POLICY_GAIN_STEPS);
    for (i = 0; i < POLICY_JOINTS; i++) {
        float most = policy_effort_limit[i];
        g->sent.effort[i] = policy_clip(g->sent.effort[i], -most, most) * g->sent_gain;
        if (policy_position_low[i] <= -1e30f && policy_position_high[i] >= 1e30f)
            g->sent.position[i] -= POLICY_TURN * g->turns[i];
    }
    return 1;
}

/* Return the status, one of POLICY_OK, POLICY_HELD, ..., and finite targets within all limits for any readings.
 *
 * time_us is when the readings were taken, now_us the current time of the same clock. Set a missing reading to NAN.
 * The drives must multiply stiffness and damping by gain, from 0 to 1.
 */
static inline int policy_update(
    policy_guard *g, const policy_readings *r, int64_t time_us, int64_t now_us, policy_targets *out, float *gain) {
    int64_t elapsed = g->called ? (now_us - g->now_us + POLICY_STEP_US / 2) / POLICY_STEP_US : 1;
    int stale = elapsed < 1 || now_us - time_us < -(POLICY_STEP_US) || now_us - time_us > POLICY_STALE_US;
    int steps = elapsed < 1 ? 1 : elapsed > POLICY_MOST_STEPS ? POLICY_MOST_STEPS : (int)elapsed;
    int i, k, status, held = 0, good = 1, lost = steps > POLICY_MISSED_STEPS + 1, upright, fallen, settled;
    float values[POLICY_NUMBERS], cosine = 0.0f;
    g->called = 1;
    g->now_us = now_us;
    memcpy(values, r, sizeof values);
    for (k = 0; k < POLICY_KINDS; k++) {
        policy_accept(g, values, k, steps, stale);
        held |= g->held[k] > 0;
        if (policy_rule[k][2] == POLICY_COMMAND) continue;
        if (g->held[k] > 0 || g->gap[k] < 0) good = 0;
        if (g->held[k] > POLICY_HOLD_STEPS || g->gap[k] < 0) lost = 1;
    }
    upright = good;
    if (POLICY_HAS_TILT) {
        for (i = 0; i < policy_rule[POLICY_GRAVITY][1]; i++)
            cosine += g->last[policy_rule[POLICY_GRAVITY][0] + i] * policy_upright[i];
        upright = good && cosine >= POLICY_RECOVER_COSINE;
        if (g->held[POLICY_GRAVITY] == 0) g->tilted = cosine < POLICY_FALL_COSINE ? policy_added(g->tilted, steps) : 0;
    }
    fallen = g->tilted >= POLICY_FALL_STEPS;
    g->phase_steps = policy_added(g->phase_steps, steps);
    settled = g->phase == POLICY_REST ? good && policy_below(g, policy_still) : upright && policy_below(g, policy_slow);
    g->calm = settled ? policy_added(g->calm, steps) : 0;
    if (g->phase == POLICY_REST) {
        if (g->calm >= POLICY_REST_STEPS) policy_enter(g, POLICY_LIFT, POLICY_STOPPED);
    } else if (g->phase == POLICY_STOP) {
        if (fallen) g->reason = POLICY_FALLEN;
        if (g->calm >= (g->reason == POLICY_FALLEN ? POLICY_FALLEN_STEPS : POLICY_STOPPED_STEPS))
            policy_enter(g, POLICY_RUN, POLICY_STOPPED);
    } else if (lost || (fallen && g->phase == POLICY_RUN)) {
        policy_enter(g, POLICY_STOP, lost ? POLICY_STOPPED : POLICY_FALLEN);
    } else if (g->phase == POLICY_LIFT && g->phase_steps > POLICY_LIFT_STEPS && g->calm >= POLICY_UPRIGHT_STEPS) {
        policy_enter(g, POLICY_RUN, POLICY_STOPPED);
    }
    status = held ? POLICY_HELD : steps > 1 ? POLICY_LATE : POLICY_OK;
    if (g->phase == POLICY_RUN && !policy_run(g, steps)) policy_enter(g, POLICY_STOP, POLICY_STOPPED);
    if (g->phase != POLICY_RUN) {
        policy_at_rest(g);
        status = g->phase == POLICY_STOP ? g->reason : POLICY_STARTING;
    }
    *out = g->sent;
    *gain = g->sent_gain;
    return status;
}
