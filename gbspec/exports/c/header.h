/* An input over time: `count` values (at least one) at increasing times. A dose: amounts at times, in any number. */
typedef struct {
    int count;
    const double *times, *values;
} PREFIX_course;

/* The learned values and the model's constants; conditions at their defaults. */
void PREFIX_defaults(PREFIX_parameters *p);

/* Replaces the initial values that the model gives by expressions; the others stay. */
void PREFIX_initial(const PREFIX_parameters *p, double *x);

/* The derivative of the initial state along (dp, dx). */
void PREFIX_initial_along(const PREFIX_parameters *p, const double *x, const PREFIX_parameters *dp, const double *dx,
                          double *out);

/* The time derivative of the states, the channels, and the values of the learned functions where the model asks them.
   A vector that has no components may be NULL. */
void PREFIX_rhs(const PREFIX_parameters *p, double t, const double *x, const double *u, double *dx);
void PREFIX_observe(const PREFIX_parameters *p, double t, const double *x, const double *u, double *y);
void PREFIX_functions(const PREFIX_parameters *p, double t, const double *x, const double *u, double *values);

/* Their exact derivatives along the direction (dp, dt, dx, du); a part that is NULL is zero. */
void PREFIX_rhs_along(const PREFIX_parameters *p, double t, const double *x, const double *u, const PREFIX_parameters *dp,
                      double dt, const double *dx, const double *du, double *out);
void PREFIX_observe_along(const PREFIX_parameters *p, double t, const double *x, const double *u,
                          const PREFIX_parameters *dp, double dt, const double *dx, const double *du, double *out);
void PREFIX_functions_along(const PREFIX_parameters *p, double t, const double *x, const double *u,
                            const PREFIX_parameters *dp, double dt, const double *dx, const double *du, double *out);

/* Whether a learned function is asked outside of the ranges that it learned from; `which` (or NULL) says it of each. */
int PREFIX_outside(const PREFIX_parameters *p, double t, const double *x, const double *u, int *which);

/* The quantities whose signs decide which branches of choices (`if`) are taken. */
void PREFIX_switches(const PREFIX_parameters *p, double t, const double *x, const double *u, double *z);

/* For each dose the fraction of it that arrives, and the lag after which it does. */
void PREFIX_doses(const PREFIX_parameters *p, double *fraction, double *lag);

/* One step of length h from t; `u` has the inputs (and behind them the delayed values) at the nodes of the method, node by
   node. */
void PREFIX_step(const PREFIX_parameters *p, double t, double h, const double *u, double *x);

#if DELAYS
/* The same with inputs `value + slope * (time - begin)` and delayed values of the past, to which the step is added. Returns
   0, or 1 if there is no room for what is still needed. */
int PREFIX_move(const PREFIX_parameters *p, double begin, const double *value, const double *slope, double t, double h,
                double *x, PREFIX_past *past);
#else
/* The same with inputs `value + slope * (time - begin)`. */
void PREFIX_move(const PREFIX_parameters *p, double begin, const double *value, const double *slope, double t, double h,
                 double *x);
#endif

/* States and channels (row by row; either may be NULL) at `count` increasing times from x0 at `start`, in equal steps of
   at most `max_step` between outputs, changes of inputs and doses. An output at the time of a dose is before it. `doses`
   may be NULL. Returns 0, 1 for wrong arguments, 2 if the solution is not finite, 3 if events follow without end, 4 if the past of a
   model with delays, which it begins anew, has no room. */
int PREFIX_simulate(const PREFIX_parameters *p, double start, const double *x0, const PREFIX_course *inputs,
                    const PREFIX_course *doses, int count, const double *times, double max_step, double *states,
                    double *channelsPAST);

/* Each learned function at any arguments. */
