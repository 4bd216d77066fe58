/* Of each delay how long it is; a delay stands in DELAY_LAG by the place of its length. */
void PREFIX_lags(const PREFIX_parameters *p, double *lags);

/* The quantities that are delayed, of the state and the inputs of a time, without delayed values. */
void PREFIX_delayed(const PREFIX_parameters *p, double t, const double *x, const double *u, double *values);

/* The state before the start, where it was x. */
void PREFIX_history(const PREFIX_parameters *p, double t, const double *x, double *before);

#ifndef PREFIX_PIECES
#define PREFIX_PIECES ROOM /* the most steps that are remembered; more are needed for longer delays or shorter steps */
#endif

/* A step: states and their rates at both ends, between which they are cubic, and inputs, which are linear. */
typedef struct {
    double t, h, x0[PREFIX_STATES], f0[PREFIX_STATES], x1[PREFIX_STATES], f1[PREFIX_STATES];
    double u0[PREFIX_INPUTS + 1], u1[PREFIX_INPUTS + 1];
} PREFIX_piece;

/* The solution so far: its start with state and inputs, the last steps in a ring, and the times to come at which jumps
   show again after delays, each with the number of delays after its jump. */
typedef struct {
    double start, x[PREFIX_STATES], u[PREFIX_INPUTS + 1], mark[PREFIX_MARKS];
    int wave[PREFIX_MARKS], marks, first, count;
    PREFIX_piece piece[PREFIX_PIECES];
} PREFIX_past;

/* Begins a solution at a time, before what jumps there. */
void PREFIX_begin(const PREFIX_parameters *p, double t, const double *x, const double *u, PREFIX_past *past);

/* The delayed values at a time; where it meets a jump, those on the side of the time `toward`. They stand behind the inputs
   in the argument `u` of the functions above. */
void PREFIX_late(const PREFIX_parameters *p, const PREFIX_past *past, double t, double toward, double *values);

/* Their derivative by the time, the parameters and, where they are given, state and inputs at the start; the steps of the
   past are fixed. */
void PREFIX_late_along(const PREFIX_parameters *p, const PREFIX_past *past, double t, double toward,
                       const PREFIX_parameters *dp, double dt, const double *dx, const double *du, double *out);

/* At a jump of states or inputs: it shows again after each delay. At any time: what has shown now shows again too. */
void PREFIX_jump(const PREFIX_parameters *p, double t, PREFIX_past *past);
void PREFIX_reach(const PREFIX_parameters *p, double t, PREFIX_past *past);

/* The next time at which a jump shows again, where a step has to end; infinite if none is to come. */
double PREFIX_mark(const PREFIX_past *past);

/* The shortest delay: no step may be longer. */
double PREFIX_shortest(const PREFIX_parameters *p);

/* Adds a step to the past. Returns 0, or 1 if there is no room for what is still needed. */
int PREFIX_keep(const PREFIX_parameters *p, const PREFIX_piece *step, PREFIX_past *past);

